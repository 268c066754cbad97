"""Whether a press can be trusted: convergence, balance of forces and penetration in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vsfsim.core.rigid import PressSpec
from vsfsim.core.shape import Box, Cylinder, ProbeShape
from vsfsim.generate.press_result import Column
from vsfsim.generate.record import BALANCE, audit
from vsfsim.physics.solve.frames import Frames, Reason

SMALL = 0.85
"""Smallest det F at which small strain is accepted [-]: case S1 at 5 mm has 0.87, and small strain is 3.6 % low there
(docs/physics.md)."""
PENETRATION = 0.01  # of an element's edge: the penetration that the solver promises [-]


def statement(frames: Frames, *, edge: float, tolerance: float, linear: bool = False, det_f: bool = True) -> str:
    """One paragraph: did every frame converge, how well do the forces balance, how deep is the penetration.

    Args:
        frames: of one touch.
        edge: mean edge of the mesh [m].
        tolerance: of the residual [-].
        linear: the tier assumes small strain.
        det_f: say the smallest det F; an incompressible membrane has none.
    """
    good = frames.converged[:, 0]
    total = len(good)
    if good.all():
        head = f"All {total} frames converged." if total > 1 else "The frame converged."
    else:
        head = (f"{_failed(good, [Reason(int(code)).text or 'out of tolerance' for code in frames.reason[:, 0]])} "
                f"Their forces are not those of an equilibrium. Take more frames, a finer mesh (a lower resolution in "
                f"[object]), or a shallower press.")
    balance = float(frames.force_balance[:, 0].max())
    deepest = float(frames.penetration[:, 0].max()) + 0.0  # no minus zero
    det = float(frames.min_det_f[:, 0].min())
    words = [head, f"Force on the bodies and reaction of the supports agree to {balance:.1e}"
             + (f", more than the {BALANCE:g} that is allowed;" if balance > BALANCE else ";"),
             f"residual at most {float(frames.residual[:, 0].max()):.1e} (tolerance {tolerance:g});",
             f"deepest penetration {1e6 * deepest:.2g} um, {100 * deepest / edge:.2g} % of an element"
             + (", more than the 1 % that is aimed at" if deepest > PENETRATION * edge else "")
             + (";" if det_f else ".")]
    if det_f:
        words.append(f"smallest det F {det:.3f}" + (": an element is turned inside out." if det <= 0.0 else "."))
    if linear and det < SMALL:
        words.append(f"That is no longer small strain, which tier linear assumes (det F over {SMALL:g}): its force may "
                     f"be off by ten per cent and more; run it with --tier fem.")
    return " ".join(words)


def _failed(good: np.ndarray, reasons: list[str]) -> str:
    """How many frames did not converge (T,), and which ones for which reason."""
    why: dict[str, list[str]] = {}
    for t in np.flatnonzero(~good):
        why.setdefault(reasons[t], []).append(str(t + 1))
    listing = "; ".join(f"{', '.join(at[:10])}{', ..' if len(at) > 10 else ''}: {reason}" for reason, at in why.items())
    return f"{len(good) - int(good.sum())} of {len(good)} frames did NOT converge ({listing})."


def solved(frames: Frames) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fields of a `PressResult`, and entries of its ``more``, that a solver's frames of one touch give."""
    return ({"converged": frames.converged[:, 0], "residual": frames.residual[:, 0],
             "iterations": frames.iterations[:, 0], "audit": audit(frames, 0)},
            {"slipping": frames.slipping[:, 0], "seconds": frames.seconds,
             "reason": tuple(Reason(r).text for r in frames.reason[:, 0])})


def series(depth: np.ndarray, force: np.ndarray, reaction: np.ndarray,
           fields: Mapping[str, Any], supports: str = "of the supports, world") -> dict[str, tuple[np.ndarray, str]]:
    """Arrays of `PressResult.arrays` that every effector saves; ``fields`` as of `solved`."""
    units = {"force_balance": "(T,) [-]", "min_det_f": "(T,) [-]; 1 for an incompressible membrane",
             "energy": "(T,) [J]", "penetration": "(T,) [m]"}
    return {"depth": (depth, "(T,) [m]"), "force": (force, "on the effector, world (T, 3) [N]"),
            "reaction": (reaction, f"{supports} (T, 3) [N]"), "converged": (fields["converged"], "(T,)"),
            "residual": (fields["residual"], "(T,) [-]"), "iterations": (fields["iterations"], "(T,)"),
            **{name: (values, units[name]) for name, values in fields["audit"].items()}}


FORCES = ("normal N is the component of the force against the direction of the press, which the tasks call "
          "normal-force; |force| N is the length of the force.")
"""Printed below a table with both."""


def force_columns(depth: np.ndarray, force: np.ndarray, axis: np.ndarray) -> list[Column]:
    """Columns of depth (T,) [m] and force (T, 3) [N] in a press along ``axis`` (3,)."""
    return [Column("depth mm", 1e3 * depth, ".3f"), Column("normal N", -(force @ axis), ".4f"),
            Column("|force| N", np.linalg.norm(force, axis=1), ".4f"),
            *(Column(name, force[:, k], ".4f") for k, name in enumerate(("fx", "fy", "fz")))]


def solver_columns(frames: Frames, edge: float) -> list[Column]:
    """Columns of penetration over the mesh's ``edge`` [m], residual, iterations and seconds."""
    return [Column("penetr. %", 100 * frames.penetration[:, 0] / edge, ".2g"),
            Column("residual", frames.residual[:, 0], ".1e"), Column("iterations", frames.iterations[:, 0], "d"),
            Column("s", frames.seconds, ".2f")]


def direction(spec: PressSpec) -> np.ndarray:
    """Unit direction (3,) of the first part of the path that goes anywhere; down for a turn on the spot."""
    for a, b in zip(spec.path[:-1], spec.path[1:], strict=True):
        if a != b:
            way = np.array(b) - np.array(a)
            return way / np.linalg.norm(way)
    return np.array([0.0, 0.0, -1.0])


def path_notes(gap: float, way: float, inside: float = 0.0) -> list[str]:
    """What a user should know about the path: it misses the body, or starts in it.

    Args:
        gap: to first contact from the start [m].
        way: how far the probe goes [m].
        inside: overlap at the start [m].
    """
    if gap >= way:
        there = ("meets nothing on its line" if not np.isfinite(gap)
                 else f"would meet it after {1e3 * gap:.1f} mm, and goes {1e3 * way:.1f} mm")
        return [f"The probe never touches the body: it {there}. Check from and to in [press], world coordinates in "
                f"metres of the probe's centre."]
    if inside > 0.05 * way:  # less is the faceting of a round body
        return [f"The probe starts {1e3 * inside:.1f} mm inside the body, so depth counts from there and not from "
                f"first contact; move from in [press] back to where the probe is free."]
    return []


def edge_notes(names: Sequence[str], shapes: Sequence[ProbeShape], body_force: np.ndarray) -> list[str]:
    """What a user should know where a rigid body with sharp edges touches.

    Args:
        names: of the bodies (K).
        shapes: of the bodies (K).
        body_force: force on each (T, K, 3) [N]; NaN in frames that did not converge.
    """
    sharp = [name for name, shape, force in zip(names, shapes, np.moveaxis(body_force, 1, 0), strict=True)
             if isinstance(shape, (Box, Cylinder)) and np.nan_to_num(force).any()]
    if not sharp:
        return []
    return [f"The contact has sharp edges ({', '.join(sharp)}), where the pressure has no bound: the force converges "
            f"slowly with the element size, and a coarse mesh is too stiff. Compare meshes with --refine 3."]


def of_mesh(progress: Callable[[int, int, str], None] | None, mesh: int,
            meshes: int) -> Callable[[int, int, str], None] | None:
    """The progress of one mesh of several."""
    if progress is None:
        return None
    return lambda done, total, what: progress(done, total, f"{what} of mesh {mesh + 1} of {meshes}")
