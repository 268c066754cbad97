"""What methods share: the visible cloud of a view, or why there is none, the one place where they check a view; a key
of what a method has seen, under which it keeps what it computed from it; and the file of what it has learned."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.baselines.converted import Units
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View


def visible_cloud(view: View) -> np.ndarray:
    """The visible cloud, world (k, 3) [m], with at least one point.

    Raises:
        MethodError: the mask is empty, or a pixel of it has no depth.
    """
    mask = np.asarray(view.mask, bool)
    if not mask.any():
        raise MethodError("the view shows no object: its mask is empty. Point the camera at the object.")
    depth = np.asarray(view.depth, np.float64)[mask]
    lost = int(np.count_nonzero(~(np.isfinite(depth) & (depth > 0.0))))
    if lost:
        raise MethodError(f"the view's depth is 0 or not a number in {lost} of the {depth.size} pixels of its mask; "
                          f"leave them out of the mask.")
    return view.points()


def digest(*arrays: np.ndarray) -> bytes:
    """A hash of the arrays' bytes."""
    out = hashlib.blake2b()
    for array in arrays:
        out.update(np.ascontiguousarray(array).tobytes())
    return out.digest()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch until the block ends: between matrices of a hundred rows more threads wait for each other."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class LearnedArrays:
    """A method whose `meta_fit` sets `_learned`, arrays by name."""

    _name = ""
    """Of the method, and of its file."""
    _settings: tuple[str, ...] = ()
    """Attributes without which the arrays say nothing: a method with others does not load them."""
    _arrays: dict[str, np.ndarray] | None = None
    _units = Units()

    @property
    def _learned(self) -> dict[str, np.ndarray]:
        if self._arrays is None:
            raise MethodError(f"{self._name} has learned nothing yet; call meta_fit or load first.")
        return self._arrays

    @_learned.setter
    def _learned(self, arrays: dict[str, np.ndarray]) -> None:
        self._arrays = arrays

    def save(self, folder: Path) -> None:
        """Write what was learned to a folder, which is made if missing."""
        arrays: dict[str, Any] = {**self._learned, "units": np.array(astuple(self._units))}
        arrays |= {f"set.{key}": np.array(str(getattr(self, key))) for key in self._settings}
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(folder / f"{self._name}.npz", **arrays)

    def load(self, folder: Path) -> None:
        """Read what `save` wrote.

        Raises:
            MethodError: there is nothing, or it was learned with other settings.
        """
        try:
            with np.load(folder / f"{self._name}.npz") as file:
                arrays = dict(file)
        except (OSError, ValueError) as error:
            raise MethodError(f"{self._name}: nothing that was learned can be read from '{folder}': {error}. Give a "
                              f"folder that `save` wrote.") from error
        for key in self._settings:
            there, here = str(arrays.pop(f"set.{key}", "")), str(getattr(self, key))
            if there != here:
                raise MethodError(f"{self._name}: what lies in '{folder}' was learned with {key} '{there}', not "
                                  f"'{here}'. Give --set {key}={there}.")
        self._units = Units(*arrays.pop("units").tolist())
        self._learned = arrays
