"""What an effector gives to `vsfsim press`: the record of a touch, with table, curves, bodies to draw, arrays to save.

The effector fills a `PressResult`; `vsfsim.press` prints, draws and saves it without knowing the effector.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.core.scene_tables.request import Request
from vsfsim.data.records import Touch
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.sensing.surface import Surface

_NO_LIMIT = 10**9


def limited(options: SolverOptions, request: Request) -> SolverOptions:
    """The options with a request's tolerance and time limit. Who states a time is ready to wait that long, so that the
    limits of a frame's iterations, which end it on every machine alike, do not end it before."""
    if request.tolerance is not None:
        options = dataclasses.replace(options, tolerance=request.tolerance)
    if request.limit is None:
        return options
    return dataclasses.replace(options, seconds=request.limit, cg_frame=_NO_LIMIT, newton_frame=_NO_LIMIT)


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
    """One press of T frames: a touch that is kept, with what is printed, drawn and saved of it."""

    touch: Touch
    """Its record, as a dataset holds it."""
    depth: np.ndarray
    """How far the effector is past first contact, or past its target (T,) [m]."""
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
    panels: Callable[[int], tuple[Panel, ...]]
    """What the picture of a frame shows, by its number, in the colours and from the camera of the frame of full
    depth."""
    arrays: Mapping[str, tuple[np.ndarray, str]]
    """What ``--save`` writes, by key: the array, and its shape and unit in words."""
    edge: float = 0.0
    """Edge of the elements that the error of the force scales with [m]; 0 without elements."""
    caption: str = ""
    """What the picture shows, for the line below it."""

    force = property(lambda self: self.touch.force)
    """Contact force on the effector, in the world (T, 3) [N]."""
    axis = property(lambda self: self.touch.axis)
    """Unit direction of the press, in the world (3,) [-]; of a path with corners, of its first part."""
    reaction = property(lambda self: self.touch.reaction)
    """Force of the supports on what is pressed, or of the mount on the sensor, in the world (T, 3) [N]."""
    converged = property(lambda self: self.touch.converged)
    """Whether each frame is an equilibrium within the solver's tolerance, whose forces balance (T,)."""
    residual = property(lambda self: self.touch.residual)
    """Unbalanced force over contact force (T,) [-]."""
    iterations = property(lambda self: self.touch.iterations)
    """Newton iterations (T,)."""
    audit = property(lambda self: self.touch.audit)
    """Columns of the audit, each (T,); see `Touch.audit`."""
    resolved = property(lambda self: self.touch.resolved)
    """Whether the mesh resolves each frame (T,), see `physics.mesh.resolved`; None where that is not measured."""

    @property
    def normal_force(self) -> np.ndarray:
        """Component of the force against the direction of the press (T,) [N]: the quantity that tasks call
        normal-force."""
        return self.touch.normal_force()

    def table(self) -> dict[str, Any]:
        """What ``--json`` prints: lists, numbers and texts by key."""
        names = ("depth", "force", "normal_force", "axis", "reaction", "converged", "residual", "iterations", "audit",
                 "notes", *(() if self.resolved is None else ("resolved",)))
        return plain({**{name: getattr(self, name) for name in names}, **self.more})


def frames_done(progress: Callable[[int, int, str], None] | None, total: int) -> Callable[[int], None] | None:
    """From frames newly done to (frames done, in all, what)."""
    if progress is None:
        return None
    done = [0]

    def tell(new: int) -> None:
        done[0] += new
        progress(done[0], total, "frames")

    return tell


def plain(value: Any) -> Any:
    """Arrays and tuples as lists, also inside a mapping."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value
