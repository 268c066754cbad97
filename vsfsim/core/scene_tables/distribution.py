"""Distributions in a scene file: ``{ uniform = [a, b] }``, ``{ loguniform = [a, b] }``, ``{ choice = [..] }`` or
``{ each = [..] }`` in the place of any value. Of ``each``, object number k of a dataset takes entry k, and the list
begins again after its end."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError

_DISTRIBUTIONS = ("uniform", "loguniform", "choice", "each")


def sample(tree: Any, rng: np.random.Generator, *, number: int = 0) -> Any:
    """The tree with every distribution drawn, in the order of the file; a choice may hold distributions itself.

    Args:
        tree: the parsed scene.
        rng: random stream.
        number: of the object in its dataset, from 0.
    """
    if _is_distribution(tree):
        kind, args = next(iter(tree.items()))
        if kind == "each":
            drawn = args[number % len(args)]
        elif kind == "choice":
            drawn = args[int(rng.integers(len(args)))]
        elif kind == "uniform":
            drawn = float(rng.uniform(args[0], args[1]))
        else:
            drawn = float(math.exp(rng.uniform(math.log(args[0]), math.log(args[1]))))
        return sample(drawn, rng, number=number)
    if isinstance(tree, Mapping):
        return {key: sample(value, rng, number=number) for key, value in tree.items()}
    return [sample(value, rng, number=number) for value in tree] if isinstance(tree, list) else tree


def _is_distribution(node: Any) -> bool:
    return isinstance(node, Mapping) and len(node) == 1 and next(iter(node)) in _DISTRIBUTIONS


def ends(node: Any, where: str) -> list:
    """Trees without distributions in which every end of every distribution, nested ones too, occurs at least once.

    Raises:
        SceneError: a distribution without numbers, or with its ends in the wrong order; ``where`` begins the message.
    """
    if _is_distribution(node):
        kind, args = next(iter(node.items()))
        _check_distribution(kind, args, where)
        return [end for value in args for end in ends(value, where)]
    if isinstance(node, Mapping):
        inner = {key: ends(value, f"{where}: {key}") for key, value in node.items()}
        return [{key: some[i % len(some)] for key, some in inner.items()}
                for i in range(max((len(e) for e in inner.values()), default=1))]
    if isinstance(node, list):
        items = [ends(value, f"{where}[{i}]") for i, value in enumerate(node)]
        return [[some[i % len(some)] for some in items] for i in range(max((len(e) for e in items), default=1))]
    return [node]


def _check_distribution(kind: str, args: Any, where: str) -> None:
    if not isinstance(args, list) or not args:
        raise SceneError(f"{where}: distribution {{ {kind} = {args!r} }}: give a list, e.g. "
                         f"{{ uniform = [0.1, 0.2] }}.")
    if kind in ("choice", "each"):
        return
    if len(args) != 2 or any(isinstance(v, bool) or not isinstance(v, (int, float)) or not math.isfinite(v)
                             for v in args):
        raise SceneError(f"{where}: distribution {{ {kind} = {args!r} }}: give two finite numbers [low, high].")
    low, high = args
    if low > high or (kind == "loguniform" and low <= 0):
        need = "0 < low <= high" if kind == "loguniform" else "low <= high"
        raise SceneError(f"{where}: distribution {{ {kind} = {args!r} }}: it must satisfy {need}.")
