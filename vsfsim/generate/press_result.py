"""What an effector gives to `vsfsim press`: numbers, table, curves, bodies to draw, arrays to save.

The effector fills a `PressResult`; `vsfsim.press` prints, draws and saves it without knowing the effector.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.sensing.surface import Surface

_NO_LIMIT = 10**9


@dataclass(frozen=True)
class PressRequest:
    """The options of `vsfsim press` that an effector needs."""

    seed: int = 0
    """Seed of the scene's distributions and of all random streams (0 or more)."""
    tier: str | None = None
    """Fidelity, or None for the scene's own."""
    device: str = "cpu"
    """Warp device."""
    cache: Path | None = None
    """Folder of meshes that were made before, or None for the user's own cache."""
    seconds: float | None = None
    """Limit of a frame's processor time [s], or None for the tier's own."""
    keep: bool = False
    """Whether `PressResult.panels` and `PressResult.arrays` are filled."""
    progress: Callable[[int, int, str], None] | None = None
    """Called with (done, in all, what)."""
    tolerance: float | None = None
    """Of the equilibrium, see `SolverOptions`, or None for the tier's own."""

    def limited(self, options: SolverOptions) -> SolverOptions:
        """The options with this request's tolerance and time limit. Who states a time is ready to wait that long, so
        that the limits of a frame's iterations, which end it on every machine alike, do not end it before."""
        if self.tolerance is not None:
            options = dataclasses.replace(options, tolerance=self.tolerance)
        if self.seconds is None:
            return options
        return dataclasses.replace(options, seconds=self.seconds, cg_frame=_NO_LIMIT, newton_frame=_NO_LIMIT)


@dataclass(frozen=True)
class Column:
    """One column of a printed table: a quantity in every row."""

    heading: str
    """Name and unit."""
    values: np.ndarray | Sequence[Any]
    """One value a row (T,), in the unit of the heading."""
    form: str = ""
    """Format specification of a value, e.g. ".4f"."""

    def cells(self) -> list[str]:
        """The values as text; no minus before a zero, and a dash where there is no value (NaN)."""
        return [v if isinstance(v, str) else "-" if v != v else format(v + 0, self.form) for v in self.values]


@dataclass(frozen=True)
class Curves:
    """One panel of the plot: quantities of one unit against depth."""

    label: str
    """Label of the axis, with the unit."""
    values: Mapping[str, np.ndarray]
    """Values (T,) by their name in the legend, in the unit of the label."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera of a drawn panel."""

    intrinsics: np.ndarray
    """Pinhole matrix (3, 3) [px]."""
    pose: np.ndarray
    """Camera to world (4, 4) [m]."""
    width: int
    """Of the picture [px]."""
    height: int
    """Of the picture [px]."""


@dataclass(frozen=True)
class Colours:
    """How numbers become colours."""

    name: str
    """Colour map of matplotlib."""
    low: float
    """Value of its lower end, in the unit of the label; below zero, the map's middle is zero."""
    high: float
    """Value of its upper end, in the unit of the label."""
    label: str = ""
    """Label of the colour bar with its unit; empty for no bar."""
    grey_zero: bool = False
    """Draw values of zero and less in light grey."""


@dataclass(frozen=True)
class BodyPanel:
    """A rendered body, and rigid bodies in grey."""

    surface: Surface
    """The body; its appearance is drawn where there are no values."""
    camera: Camera
    """Where it is seen from."""
    rigid: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    """Vertices (v, 3) [m] and triangles (g, 3) of each rigid body, in the surface's frame."""
    values: np.ndarray | None = None
    """One value a triangle of the surface (f,), in the unit of the colours."""
    colours: Colours | None = None
    """Of the values."""


@dataclass(frozen=True)
class MapPanel:
    """Values on a triangle mesh in the plane, and dots on it."""

    points: np.ndarray
    """Of the mesh (n, 2) [mm]."""
    triangles: np.ndarray
    """Node indices (f, 3)."""
    values: np.ndarray
    """One value a node (n,), in the unit of the colours."""
    dots: np.ndarray
    """Relative size of the dot of each node (n,), 0 for none [-]."""
    colours: Colours
    """Of the values."""
    labels: tuple[str, str]
    """Of the two axes."""


@dataclass(frozen=True)
class ImagePanel:
    """A picture that a sensor takes."""

    rgb: np.ndarray
    """sRGB (H, W, 3) uint8."""


Panel = BodyPanel | MapPanel | ImagePanel


@dataclass(frozen=True)
class PressResult:
    """One press of T frames."""

    depth: np.ndarray
    """How far the effector is past first contact, or past its target (T,) [m]."""
    force: np.ndarray
    """Contact force on the effector, in the world (T, 3) [N]."""
    axis: np.ndarray
    """Unit direction of the press, in the world (3,) [-]; of a path with corners, of its first part."""
    reaction: np.ndarray
    """Force of the supports on what is pressed, or of the mount on the sensor, in the world (T, 3) [N]."""
    converged: np.ndarray
    """Whether each frame is an equilibrium within the solver's tolerance (T,)."""
    residual: np.ndarray
    """Unbalanced force over contact force (T,) [-]."""
    iterations: np.ndarray
    """Newton iterations (T,)."""
    audit: Mapping[str, np.ndarray]
    """Columns of the audit, each (T,): force_balance [-], energy [J], penetration [m], and of solids min_det_f [-]."""
    deepest: int
    """Number of the frame of full depth."""
    more: Mapping[str, Any]
    """Everything else that ``--json`` prints, by key: arrays (T, ...), numbers and texts."""
    columns: tuple[Column, ...]
    """The printed table."""
    words: tuple[str, ...]
    """Lines printed below the table: convergence, model, times."""
    notes: tuple[str, ...]
    """What was assumed, repaired or decided."""
    plot: tuple[Curves, ...]
    """Panels of the plot; depth is the abscissa."""
    abscissa: str
    """Label of the plot's depth axis, in millimetres."""
    model: str
    """The model in a few words, for titles."""
    headline: str
    """Depth, force and other readings of the frame of full depth, for the picture's title."""
    caption: str = ""
    """What the picture shows, for the line below it."""
    panels: Callable[[int], tuple[Panel, ...]] | None = None
    """What the picture of a frame shows, by its number, in the colours and from the camera of the frame of full depth;
    None without `PressRequest.keep`."""
    resolved: np.ndarray | None = None
    """Whether the mesh resolves each frame (T,), see `physics.mesh.resolved`; None where that is not measured."""
    arrays: Mapping[str, tuple[np.ndarray, str]] = field(default_factory=dict)
    """What ``--save`` writes, by key: the array, and its shape and unit in words; empty without `PressRequest.keep`."""

    @property
    def normal_force(self) -> np.ndarray:
        """Component of the force against the direction of the press (T,) [N]: the quantity that `Touch.normal_force`
        gives and tasks call normal-force."""
        return -(self.force @ self.axis)

    def table(self) -> dict[str, Any]:
        """What ``--json`` prints: lists, numbers and texts by key."""
        names = ("depth", "force", "normal_force", "axis", "reaction", "converged", "residual", "iterations", "audit",
                 "notes", *(() if self.resolved is None else ("resolved",)))
        return plain({**{name: getattr(self, name) for name in names}, **self.more})


@dataclass(frozen=True)
class MeshSeries:
    """The same press on finer and finer meshes, coarsest first."""

    results: tuple[PressResult, ...]
    """One result a mesh."""
    edge: tuple[float, ...]
    """Edge h of each mesh that its error scales with [m]."""
    quantities: Mapping[str, tuple[str, list[float]]]
    """What is extrapolated, at full depth: name, unit and the value of each mesh."""
    tolerance: float
    """Relative error of a value that the solver leaves [-]."""
    title: str
    """Line above the table."""
    columns: tuple[Column, ...]
    """The printed table."""
    rows: list[dict[str, Any]]
    """What ``--json`` prints of the meshes."""
    sizes: str
    """Sizes of the meshes in words, e.g. "300, 600 tetrahedra"."""
    advice: str
    """What the user can do if two meshes come out of the same size."""


def plain(value: Any) -> Any:
    """Arrays and tuples as lists, also inside a mapping."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value
