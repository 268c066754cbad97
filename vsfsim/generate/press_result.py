"""What an effector gives to `vsfsim press`: the record of a touch, and what is printed, drawn and saved of it.

The effector fills a `PressResult`; `vsfsim.press` prints, draws and saves it without knowing the effector.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.core.rigid import PressSpec
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import ProbeShape
from vsfsim.core.text_table import text_table
from vsfsim.data.records import Touch
from vsfsim.data.schema import FIELDS
from vsfsim.generate.record import BALANCE
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.sensing.colours import Colours
from vsfsim.sensing.cut import Elements
from vsfsim.sensing.surface import Surface

PICTURE = (640, 512)  # width and height of a view [px]
PENETRATION = 0.01  # of an element's edge: the penetration that the solver promises [-]
FORCES = ("normal N is the component of the force against the direction of the press, which the "
          "tasks call normal-force; |force| N is the length of the force.")
"""Printed below a table with both."""


def limited(options: SolverOptions, request: Request) -> SolverOptions:
    """The options with a request's tolerance and time limit. Who states a time is ready to wait that long, so that the
    limits of a frame's iterations, which end it on every machine alike, do not end it before."""
    if request.tolerance is not None:
        options = dataclasses.replace(options, tolerance=request.tolerance)
    if request.limit is None:
        return options
    return dataclasses.replace(options, seconds=request.limit, cg_frame=10**9, newton_frame=10**9)


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
class BodyPanel:
    """A rendered body, and rigid bodies in grey."""

    surface: Surface
    """The body; its appearance is drawn where there are no values."""
    camera: tuple[np.ndarray, np.ndarray]
    """Where it is seen from: pinhole matrix (3, 3) [px], and pose, camera to world (4, 4) [m]."""
    size: tuple[int, int] = PICTURE
    """Width and height of its picture [px]."""
    rigid: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    """Vertices (v, 3) [m] and triangles (g, 3) of each rigid body, in the surface's frame."""
    values: np.ndarray | None = None
    """One value a triangle of the surface (f,), in the unit of the colours; NaN is a line."""
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


Panel = BodyPanel | MapPanel | np.ndarray
"""The last is a picture that a sensor takes, sRGB (H, W, 3) uint8."""


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
    """Everything else that ``--json`` prints, by key: arrays (T, ...), numbers and texts. Of elements ``edge`` is the
    mean edge [m], ``tolerance`` that of the residual [-]; ``seconds`` is the time of each frame (T,), or in all."""
    readings: tuple[Column, ...]
    """Of the printed table, what this effector reads besides the force; they stand before the audit."""
    said: tuple[str, ...]
    """Lines printed below the statement of convergence: model, times."""
    notes: tuple[str, ...]
    """What was assumed, repaired or decided."""
    plot: Mapping[str, Mapping[str, np.ndarray]]
    """Panels of the plot against depth, by the label of their axis, with the unit: values (T,) by their name in the
    legend."""
    model: str
    """The model in a few words, for titles."""
    headline: str
    """Depth, force and other readings of the frame of full depth, for the picture's title."""
    panels: Callable[[int], tuple[Panel, ...]]
    """What the picture of a frame shows, by its number, in the colours and from the camera of the frame of full
    depth."""
    arrays: Mapping[str, tuple[np.ndarray, str]]
    """What ``--save`` writes besides the record, by key: the array, and its shape and unit in words."""
    edge: float = 0.0
    """Edge of the elements that the error of the force scales with [m]; 0 without elements."""
    caption: str = ""
    """What the picture shows, for the line below it."""
    abscissa: str = "depth past first contact [mm]"
    """Label of the plot's depth axis, in millimetres."""
    first: tuple[Column, ...] = ()
    """The first columns of the printed table; empty for those of depth and force."""
    body: tuple[Elements, np.ndarray, ProbeShape, np.ndarray] | None = None
    """The elements, their nodes' displacements (T, n, 3) [m], what pressed them, and its pressure on the nodes (T, n)
    [Pa]; None without elements."""

    force = property(lambda self: self.touch.force)
    """Contact force on the effector, in the world (T, 3) [N]."""
    converged = property(lambda self: self.touch.converged)
    """Whether each frame is an equilibrium within the solver's tolerance, whose forces balance (T,)."""
    audit = property(lambda self: self.touch.audit)
    """Columns of the audit, each (T,); see `Touch.audit`."""
    resolved = property(lambda self: self.touch.resolved)
    """Whether the mesh resolves each frame (T,), see `physics.mesh.resolved`; None where that is not measured."""

    normal_force = property(lambda self: self.touch.normal_force())
    """Component of the force against the direction of the press (T,) [N]: the quantity that tasks call normal-force."""

    @property
    def reason(self) -> tuple[str, ...]:
        """Why each frame did not converge (T,), in words; empty for one that did."""
        return tuple(("", *self.touch.reason_names)[k] for k in self.touch.reason)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The printed table."""
        force, audit, edge = self.touch.force, self.audit, self.more.get("edge")
        deep, seconds = 1e3 * audit["penetration"], self.more["seconds"]
        first = self.first or (
            Column("depth mm", 1e3 * self.depth, ".3f"), Column("normal N", self.normal_force, ".4f"),
            Column("|force| N", np.linalg.norm(force, axis=1), ".4f"),
            *(Column(name, force[:, k], ".4f") for k, name in enumerate(("fx", "fy", "fz"))))
        out = [*first, *self.readings, Column("balance", audit["force_balance"], ".1e")]
        if "min_det_f" in audit:
            out.append(Column("min det F", audit["min_det_f"], ".3f"))
        if "mesh_error" in audit:
            out.append(Column("mesh err %", 100.0 * audit["mesh_error"], ".1f"))
        out += [Column("energy J", audit["energy"], ".2e"), Column("penetr. mm", deep, ".3f")
                if edge is None else Column("penetr. %", 0.1 * deep / edge, ".2g"),
                Column("residual", self.touch.residual, ".1e"),
                Column("iterations", self.touch.iterations, "d")]
        return (*out, Column("s", seconds, ".2f")) if np.ndim(seconds) else tuple(out)

    @property
    def words(self) -> tuple[str, ...]:
        """Lines printed below the table."""
        return (*(() if self.first else (FORCES,)), self.statement, *self.said)

    @property
    def statement(self) -> str:
        """One paragraph: did every frame converge, how well do the forces balance, how deep is the penetration."""
        good, audit, edge, tolerance = self.converged, self.audit, self.more.get("edge"), self.more.get("tolerance")
        if good.all():
            head = f"All {len(good)} frames converged." if len(good) > 1 else "The frame converged."
        else:
            why: dict[str, list[str]] = {}
            for t in np.flatnonzero(~good):
                why.setdefault(self.reason[t] or "out of tolerance", []).append(str(t + 1))
            listing = "; ".join(f"{', '.join(at[:10])}{', ..' if len(at) > 10 else ''}: {reason}"
                                for reason, at in why.items())
            head = (f"{int((~good).sum())} of {len(good)} frames did NOT converge ({listing}). "
                    "Their forces are not those of an equilibrium. Take more frames, a finer mesh "
                    "(a lower resolution in [object]), or a shallower press.")
        balance, deepest = (float(np.nanmax(audit[name])) + 0.0 for name in ("force_balance", "penetration"))
        words = [head, f"Force on the bodies and reaction of the supports agree to {balance:.1e}"
                 + (f", more than the {BALANCE:g} that is allowed;" if balance > BALANCE else ";"),
                 f"residual at most {float(np.nanmax(self.touch.residual)):.1e}"
                 + (";" if tolerance is None else f" (tolerance {tolerance:g});"),
                 f"deepest penetration {1e6 * deepest:.2g} um"]
        if edge is not None:
            words[-1] += f", {100 * deepest / edge:.2g} % of an element" + (
                ", more than the 1 % that is aimed at" if deepest > PENETRATION * edge else "")
        words[-1] += "."
        det = float(audit["min_det_f"].min()) if "min_det_f" in audit else 1.0
        if det != 1.0:  # that of an incompressible membrane
            words.append(f"Smallest det F {det:.3f}" + (": an element is turned inside out." if det <= 0.0 else "."))
        return " ".join(words)

    def table(self) -> dict[str, Any]:
        """What ``--json`` prints: lists, numbers and texts by key."""
        names = ("depth", "force", "normal_force", "axis", "reaction", "converged", "residual", "iterations", "audit",
                 "notes", "reason", "statement", *(() if self.resolved is None else ("resolved",)))
        told = {name: getattr(self if hasattr(self, name) else self.touch, name) for name in names}
        return plain({**told, "precision": "float64", **self.more})

    def marks(self) -> list[str]:
        """What is wrong with each frame (T,), in two words; empty for a good one."""
        resolved = np.ones(len(self.converged), bool) if self.resolved is None else self.resolved
        return ["NOT CONVERGED" if not good else "" if held else "NOT RESOLVED"
                for good, held in zip(self.converged, resolved, strict=True)]

    def text(self) -> str:
        """For people."""
        return "\n".join([as_text(self.columns, self.marks()), *self.words,
                          *(f"note: {sentence}" for sentence in self.notes)])

    def saved(self) -> dict[str, tuple[np.ndarray, str]]:
        """What ``--save`` writes: the effector's arrays, and everything that a dataset would hold of the touch, by the
        names of the schema, with shape, unit and meaning."""
        out = {**self.arrays, "depth": (self.depth, "(T,) [m]")}
        for row in FIELDS:
            name = row.path.rpartition("/")[2]
            if row.group == "touches/*" and name not in ("time", "reason_names") and (
                    value := self.touch.channel(name)) is not None:
                out[name] = (np.asarray(value), f"({row.dims_text}) [{row.unit}]: {row.doc}")
        return out


def as_text(columns: Sequence[Column], marks: Sequence[str]) -> str:
    """Columns as text, with marks at the end of the rows where there are any."""
    if any(marks):
        columns = (*columns, Column("", marks))
    return text_table([c.heading for c in columns],
                      list(zip(*(c.cells() for c in columns), strict=True)), right=True, rule=False)


def frames_done(progress: Callable[[int, int, str], None], total: int) -> Callable[[int], None]:
    """From frames newly done to (frames done, in all, what)."""
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


def direction(spec: PressSpec) -> np.ndarray:
    """Unit direction (3,) of the first part of the path that goes anywhere; down for a turn on the spot."""
    for a, b in zip(spec.path[:-1], spec.path[1:], strict=True):
        if a != b:
            way = np.array(b) - np.array(a)
            return way / np.linalg.norm(way)
    return np.array([0.0, 0.0, -1.0])
