"""`vsfsim.press(scene)` and `vsfsim press SCENE`: one press, or the same press on several meshes."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import find_scene
from vsfsim.core.system.interactive import html_table
from vsfsim.data.disk import write_atomic
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import Column, PressResult, as_text, plain
from vsfsim.physics.convergence import Convergence, convergence
from vsfsim.physics.runtime import check_device


@dataclass(frozen=True, repr=False)
class Press:
    """A press that was made: force against depth, and whether it can be trusted."""

    scene: str
    """Name of the scene."""
    results: tuple[PressResult, ...]
    """One result a mesh, coarsest first; one result without a refinement."""
    device: str
    """Warp device, also of `picture`."""
    convergence: Mapping[str, Convergence] | None = None
    """Of a refinement: order, extrapolated value and error of each quantity at full depth, by name; else None."""

    result = property(lambda self: self.results[-1])
    """The result on the only, or finest, mesh."""
    depth = property(lambda self: self.result.depth)
    """How far the effector is past first contact, or past its target (T,) [m]."""
    force = property(lambda self: self.result.force)
    """Contact force on the effector, world (T, 3) [N]."""
    normal_force = property(lambda self: self.result.normal_force)
    """Component of the force against the direction of the press (T,) [N]; what the tasks call normal-force."""

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
        words = [self.result.text()]
        if self.convergence is not None:
            words += ["", *_refined(self.results, self.convergence)]
        return "\n".join(words)

    def table(self) -> dict[str, Any]:
        """What the command writes as JSON."""
        if self.convergence is None:
            return self.result.table()
        tables = {name.replace(" ", "_"): plain(vars(c)) for name, c in self.convergence.items()}
        return {**self.result.table(), "refinement": {**(tables["normal_force"] if len(tables) == 1 else tables),
                                                      "meshes": [r.table() for r in self.results]}}

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

    def gif(self, path: str | Path, *, progress: Callable[[int, int, str], None] = lambda *_: None) -> None:
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
        saved, buffer = self.result.saved(), io.BytesIO()
        units = json.dumps({name: words for name, (_, words) in saved.items()})
        np.savez_compressed(buffer, units=np.array(units), **{name: values for name, (values, _) in saved.items()})
        write_atomic(Path(path), buffer.getvalue())

    def __repr__(self) -> str:
        result = self.result
        mark = ", NOT CONVERGED" if not self.converged else "" if self.resolved else ", NOT RESOLVED"
        return f"Press({self.scene}: {len(result.depth)} frames, {result.headline}{mark})"

    def _repr_html_(self) -> str:
        columns = self.result.columns
        rows = list(zip(*(column.cells() for column in columns), self.result.marks(), strict=True))
        return html_table(f"{self.scene}: {' '.join(self.result.words)}",
                          (*(column.heading for column in columns), ""), rows)


def press(scene: str | Path | SceneFile, request: Request | None = None, *,
          refine: int | None = None, **options: Any) -> Press:
    """Press a probe into an object; `vsfsim.press` is this function.

    Args:
        scene: name of a shipped scene, path of a .toml file, or a loaded scene.
        request: what is asked, None for the scene's own.
        refine: press 3 to 6 finer and finer meshes, for the observed order of convergence; None for one mesh.
        options: fields of `vsfsim.core.scene_tables.request.Request` that are others than those of ``request``: seed,
            tier, device, limit, tolerance, progress.

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
    results = tuple(effector.press(mesh, asked.but(progress=lambda done, total, what, number=number: asked.progress(
        done, total, f"{what} of mesh {number} of {refine}")))
                    for number, mesh in enumerate(effector.finer(loaded, asked, refine), start=1))
    return Press(loaded.name, results, asked.device, extrapolate(results, str(loaded.path)))


def extrapolate(results: Sequence[PressResult], source: str) -> dict[str, Convergence]:
    """Order, extrapolation and error of the normal force at full depth, and of a bubble's pressure, by name.

    Raises:
        SceneError: two meshes came out of the same size; ``source`` is the scene file.
    """
    edge = [r.edge for r in results]
    if -np.diff(edge).max() < 0.02 * max(edge):
        raise SceneError(f"{source}: two of the {len(edge)} meshes came out of the same size "
                         f"({', '.join(str(r.more['nodes']) for r in results)} nodes), so there is "
                         "no convergence to see; give a finer resolution in [object], or a "
                         "smaller contact_edge in [sensor].")
    wanted = {"normal force": ("N", [float(r.normal_force[r.deepest]) for r in results])}
    if "pressure_change" in results[0].more:
        wanted["pressure change"] = ("Pa", [float(r.more["pressure_change"][r.deepest]) for r in results])
    return {name: convergence(edge, values, tolerance=results[0].more["tolerance"], name=name,
                              unit=unit) for name, (unit, values) in wanted.items()}


def _refined(results: Sequence[PressResult], found: Mapping[str, Convergence]) -> list[str]:
    """The meshes as a table, and what they say of each quantity, see `vsfsim.physics.convergence`."""
    columns = [Column("mesh", range(1, len(results) + 1), "d"),
               Column("nodes", [r.more["nodes"] for r in results], "d"),
               Column("edge mm", [1e3 * r.edge for r in results], ".2f")]
    for name, one in found.items():
        columns += [Column(f"{name} {'Pa' if 'pressure' in name else 'N'}", one.force, ".5g"),
                    Column("change %", ["", *(f"{100 * (b / a - 1.0):+.2f}" if a and np.isfinite(b / a) else "-"
                                              for a, b in pairwise(one.force))])]
    columns += [Column("converged", [f"{int(r.converged.sum())}/{len(r.converged)}" for r in results]),
                Column("balance", [r.audit["force_balance"].max() for r in results], ".1e"),
                Column("penetr. %", [100 * r.audit["penetration"].max() / r.more["edge"] for r in results], ".2g"),
                Column("seconds", [r.more["build_seconds"] + r.more["seconds"].sum() for r in results], ".1f")]
    marks = ["" if r.converged.all() else "NOT CONVERGED" for r in results]
    rows = [f"At full depth on {len(results)} meshes:", as_text(columns, marks),
            *(f"At full depth: {c.statement}" for c in found.values())]
    if any(marks):
        rows.append("Some frames did not converge: their forces are no equilibria, and the order "
                    "means nothing until they do.")
    return rows
