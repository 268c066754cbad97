"""`vsfsim.press(scene)` and `vsfsim press SCENE`: one press, or the same press on several meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.interactive.html_table import html_table
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import MeshSeries, PressRequest, PressResult
from vsfsim.physics.runtime import check_device
from vsfsim.press import archive
from vsfsim.press import refine as refinement
from vsfsim.press.text import marks, text


@dataclass(frozen=True, repr=False)
class Press:
    """A press that was made: force against depth, and whether it can be trusted."""

    scene: str
    """Name of the scene."""
    results: tuple[PressResult, ...]
    """One result a mesh, coarsest first; one result without a refinement."""
    device: str
    """Warp device, also of `picture`."""
    series: MeshSeries | None = None
    """The meshes of a refinement, or None."""
    convergence: Mapping[str, refinement.Convergence] | None = None
    """Of a refinement: order, extrapolated value and error of each quantity at full depth, by name; else None."""

    @property
    def result(self) -> PressResult:
        """The result on the only, or finest, mesh."""
        return self.results[-1]

    @property
    def depth(self) -> np.ndarray:
        """How far the effector is past first contact, or past its target (T,) [m]."""
        return self.result.depth

    @property
    def force(self) -> np.ndarray:
        """Contact force on the effector, world (T, 3) [N]."""
        return self.result.force

    @property
    def normal_force(self) -> np.ndarray:
        """Component of the force against the direction of the press (T,) [N]; what the tasks call normal-force."""
        return self.result.normal_force

    @property
    def converged(self) -> bool:
        """Whether every frame, of every mesh, is an equilibrium within the solver's tolerance."""
        return all(bool(result.converged.all()) for result in self.results)

    @property
    def resolved(self) -> bool:
        """Whether the mesh, of a refinement the finest, resolves every frame; also True where that is not measured, as
        of a bubble's membrane."""
        return self.result.resolved is None or bool(self.result.resolved.all())

    def text(self) -> str:
        """What the command prints: the table of the frames, whether it can be trusted, notes, the refinement."""
        words = [text(self.result)]
        if self.series is not None and self.convergence is not None:
            words += ["", *refinement.text(self.series, self.convergence)]
        return "\n".join(words)

    def table(self) -> dict[str, Any]:
        """What the command writes as JSON."""
        if self.series is None or self.convergence is None:
            return self.result.table()
        return {**self.result.table(), "refinement": refinement.table(self.series, self.convergence)}

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the force, and what else is read, against depth; returns the `matplotlib.figure.Figure`.

        Args:
            path: PNG to write, or None.
        """
        from vsfsim.press import figures  # imports matplotlib

        return figures.plot(self.result, self.scene, path)

    def picture(self, path: str | Path | None = None) -> Any:
        """Draw the deformed body at full depth; returns the `matplotlib.figure.Figure`.

        Args:
            path: PNG to write, or None.
        """
        from vsfsim.press import figures

        return figures.picture(self.result, self.scene, path, device=self.device)

    def gif(self, path: str | Path, *, progress: Callable[[int, int, str], None] | None = None) -> None:
        """Write the pictures of all frames as a GIF that repeats.

        Raises:
            VsfsimError: the press was made without them, or the file cannot be written.
        """
        from vsfsim.press import figures

        figures.animation(self.result, self.scene, Path(path), device=self.device, progress=progress)

    def save(self, path: str | Path) -> None:
        """Write mesh, displacements and contact forces of every frame (.npz).

        Raises:
            DatasetError: the file cannot be written.
        """
        archive.save(self.result, Path(path))

    def __repr__(self) -> str:
        result = self.result
        mark = ", NOT CONVERGED" if not self.converged else "" if self.resolved else ", NOT RESOLVED"
        return f"Press({self.scene}: {len(result.depth)} frames, {result.headline}{mark})"

    def _repr_html_(self) -> str:
        columns = self.result.columns
        found = marks(self.result.converged, self.result.resolved)
        rows = list(zip(*(column.cells() for column in columns), found, strict=True))
        return html_table(f"{self.scene}: {' '.join(self.result.words)}",
                          (*(column.heading for column in columns), ""), rows)


def press(scene: str | Path | SceneFile, *, seed: int = 0, tier: str | None = None, device: str = "cpu",
          refine: int | None = None, limit: float | None = None, keep: bool = True,
          cache: Path | None = None,
          progress: Callable[[int, int, str], None] | None = None) -> Press:
    """Press a probe into an object; `vsfsim.press` is this function.

    Args:
        scene: name of a shipped scene, path of a .toml file, or a loaded scene.
        seed: of the scene's distributions and of all random streams.
        tier: fidelity, None for the scene's own.
        device: Warp device, "cpu" or "cuda:0".
        refine: press 3 to 6 finer and finer meshes, for the observed order of convergence; None for one mesh.
        limit: limit of a frame's processor time [s], None for the tier's own; a frame that takes longer is marked.
        keep: whether `Press.picture` and `Press.save` are wanted.
        cache: folder of meshes that were made before, None for the user's own cache.
        progress: called with (done, in all, what).

    Returns:
        The press. Frames that did not converge are kept and marked: see `Press.converged`.

    Raises:
        VsfsimError: there is no such scene, it cannot be built, or an option has a value that is not allowed.
    """
    loaded = scene if isinstance(scene, SceneFile) else load_scene(find_scene(str(scene)))
    check_device(device)
    request = PressRequest(seed, tier, device, cache, limit, keep, progress)
    effector = effector_of(loaded.sample(seed))
    if refine is None:
        return Press(loaded.name, (effector.press(loaded, request),), device)
    series = effector.refine(loaded, request, refine)
    return Press(loaded.name, series.results, device, series, refinement.extrapolate(series, str(loaded.path)))
