"""`vsfsim.press(scene)` and `vsfsim press SCENE`: one press, or the same press on several meshes."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import find_scene
from vsfsim.core.system.interactive import html_table
from vsfsim.data.disk import write_atomic
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import PressResult
from vsfsim.physics.runtime import check_device
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
        if self.convergence is not None:
            words += ["", *refinement.text(self.results, self.convergence)]
        return "\n".join(words)

    def table(self) -> dict[str, Any]:
        """What the command writes as JSON."""
        if self.convergence is None:
            return self.result.table()
        return {**self.result.table(), "refinement": refinement.table(self.results, self.convergence)}

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
            VsfsimError: the file cannot be written.
        """
        from vsfsim.press import figures

        figures.animation(self.result, self.scene, Path(path), device=self.device, progress=progress)

    def save(self, path: str | Path) -> None:
        """Write mesh, displacements and contact forces of every frame, and what a dataset records (.npz), with their
        shapes and units as JSON in ``units``.

        Raises:
            DatasetError: the file cannot be written.
        """
        arrays: dict[str, Any] = {name: values for name, (values, _) in self.result.arrays.items()}
        units, buffer = {name: words for name, (_, words) in self.result.arrays.items()}, io.BytesIO()
        np.savez_compressed(buffer, units=np.array(json.dumps(units)), **arrays)
        write_atomic(Path(path), buffer.getvalue())

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


def press(scene: str | Path | SceneFile, request: Request | None = None, *, refine: int | None = None,
          **options: Any) -> Press:
    """Press a probe into an object; `vsfsim.press` is this function.

    Args:
        scene: name of a shipped scene, path of a .toml file, or a loaded scene.
        request: what is asked, None for the scene's own.
        refine: press 3 to 6 finer and finer meshes, for the observed order of convergence; None for one mesh.
        options: fields of `vsfsim.core.scene_tables.request.Request` that are others than those of ``request``: seed,
            tier, device, limit, tolerance, cache, progress.

    Returns:
        The press. Frames that did not converge are kept and marked: see `Press.converged`.

    Raises:
        VsfsimError: there is no such scene, it cannot be built, something in it has no effect, or an option has a value
            that is not allowed.
    """
    asked = (request or Request()).but(**options)
    loaded = scene if isinstance(scene, SceneFile) else load_scene(find_scene(str(scene)))
    check_device(asked.device)
    effector = effector_of(loaded.sample(asked.seed))
    if refine is None:
        return Press(loaded.name, (effector.press(loaded, asked),), asked.device)
    results = tuple(effector.press(mesh, _of_mesh(asked, k, refine))
                    for k, mesh in enumerate(effector.finer(loaded, asked, refine)))
    return Press(loaded.name, results, asked.device, refinement.extrapolate(results, str(loaded.path)))


def _of_mesh(request: Request, mesh: int, meshes: int) -> Request:
    """The same press on one mesh of several, which the progress tells."""
    if (tell := request.progress) is None:
        return request
    return request.but(progress=lambda done, total, what: tell(done, total, f"{what} of mesh {mesh + 1} of {meshes}"))
