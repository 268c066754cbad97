"""Ways to choose the next touch of `TouchEnv`, and the run of one episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vsfsim.active.touch_env import TouchEnv
from vsfsim.core.errors import MethodError

Observation = Mapping[str, np.ndarray]
Chooser = Callable[[Observation, Mapping[str, Any], np.random.Generator], int]
"""(observation, info, random numbers) -> number of the next touch."""


def at_random(observation: Observation, info: Mapping[str, Any], rng: np.random.Generator) -> int:
    """Any touch that was not made."""
    return int(rng.choice(np.flatnonzero(observation["made"] == 0)))


def farthest(observation: Observation, info: Mapping[str, Any], rng: np.random.Generator) -> int:
    """The touch whose place is farthest from all places that were touched (Gonzalez 1985); the first at random."""
    left = np.flatnonzero(observation["made"] == 0)
    touched = np.flatnonzero(observation["made"] * np.abs(observation["places"]).any(axis=1))
    if not len(touched):
        return at_random(observation, info, rng)
    place = observation["places"][:, :3]
    away = np.linalg.norm(place[left, None] - place[None, touched], axis=2).min(axis=1)
    return int(left[np.argmax(away)])


def most_uncertain(observation: Observation, info: Mapping[str, Any], rng: np.random.Generator) -> int:
    """The touch whose readings the estimator knows least, by its own standard deviations.

    Raises:
        MethodError: the estimator has no `predict_std`.
    """
    if "std" not in info:
        raise MethodError("most_uncertain: the estimator has no predict_std(); choose another way, "
                          "or an estimator that has it, say surface-gp or sbml.")
    return int(np.argmax(np.where(observation["made"] == 0, info["std"], -np.inf)))


def episode(env: TouchEnv, choose: Chooser, *, seed: int, name: str | None = None) -> np.ndarray:
    """One episode from ``seed``.

    Returns:
        The error before the first touch and after each (touches + 1,), over that of predicting zero.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    options: dict[str, Any] | None = None if name is None else {"object": name}
    observation, info = env.reset(seed=seed, options=options)
    errors, ended = [info["error"]], False
    while not ended:
        observation, _, ended, _, info = env.step(np.int64(choose(observation, info, rng)))
        errors.append(info["error"])
    return np.array(errors)
