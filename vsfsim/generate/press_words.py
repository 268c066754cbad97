"""A press in words and numbers, from the record of its touch: columns of the table, whether it can be trusted, notes,
arrays to save."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.core.rigid import PressSpec
from vsfsim.core.shape import Box, Cylinder, ProbeShape
from vsfsim.data.records import Touch
from vsfsim.data.schema import FIELDS
from vsfsim.generate.press_result import Column
from vsfsim.generate.record import BALANCE

SMALL = 0.85
"""Smallest det F at which small strain is accepted [-]: case S1 at 5 mm has 0.87, and small strain is 3.6 % low there
(docs/physics.md)."""
PENETRATION = 0.01  # of an element's edge: the penetration that the solver promises [-]
FORCES = ("normal N is the component of the force against the direction of the press, which the tasks call "
          "normal-force; |force| N is the length of the force.")
"""Printed below a table with both."""


def statement(touch: Touch, *, edge: float | None, tolerance: float | None, linear: bool = False) -> str:
    """One paragraph: did every frame converge, how well do the forces balance, how deep is the penetration.

    Args:
        touch: the record.
        edge: mean edge of the mesh [m]; None without elements.
        tolerance: of the residual [-]; None where it is the solver's own.
        linear: the tier assumes small strain.
    """
    good, audit = touch.converged, touch.audit
    if good.all():
        head = f"All {len(good)} frames converged." if len(good) > 1 else "The frame converged."
    else:
        why: dict[str, list[str]] = {}
        for t in np.flatnonzero(~good):
            why.setdefault(reasons(touch)[t] or "out of tolerance", []).append(str(t + 1))
        listing = "; ".join(f"{', '.join(at[:10])}{', ..' if len(at) > 10 else ''}: {reason}"
                            for reason, at in why.items())
        head = (f"{int((~good).sum())} of {len(good)} frames did NOT converge ({listing}). Their forces are not those "
                f"of an equilibrium. Take more frames, a finer mesh (a lower resolution in [object]), or a shallower "
                f"press.")
    balance, deepest = (float(np.nanmax(audit[name])) + 0.0 for name in ("force_balance", "penetration"))
    words = [head, f"Force on the bodies and reaction of the supports agree to {balance:.1e}"
             + (f", more than the {BALANCE:g} that is allowed;" if balance > BALANCE else ";"),
             f"residual at most {float(np.nanmax(touch.residual)):.1e}"
             + (";" if tolerance is None else f" (tolerance {tolerance:g});"),
             f"deepest penetration {1e6 * deepest:.2g} um"]
    if edge is not None:
        words[-1] += f", {100 * deepest / edge:.2g} % of an element" + (
            ", more than the 1 % that is aimed at" if deepest > PENETRATION * edge else "")
    words[-1] += "."
    det = float(audit["min_det_f"].min()) if "min_det_f" in audit else 1.0
    if det != 1.0:  # that of an incompressible membrane
        words.append(f"Smallest det F {det:.3f}" + (": an element is turned inside out." if det <= 0.0 else "."))
    if linear and det < SMALL:
        words.append(f"That is no longer small strain, which tier linear assumes (det F over {SMALL:g}): its force may "
                     f"be off by ten per cent and more; run it with --tier fem.")
    return " ".join(words)


def reasons(touch: Touch) -> tuple[str, ...]:
    """Why each frame did not converge (T,), in words; empty for one that did."""
    return tuple(("", *touch.reason_names)[k] for k in touch.reason)


def force_columns(depth: np.ndarray, touch: Touch) -> list[Column]:
    """Columns of depth (T,) [m] and force."""
    return [Column("depth mm", 1e3 * depth, ".3f"), Column("normal N", touch.normal_force(), ".4f"),
            Column("|force| N", np.linalg.norm(touch.force, axis=1), ".4f"),
            *(Column(name, touch.force[:, k], ".4f") for k, name in enumerate(("fx", "fy", "fz")))]


def audit_columns(touch: Touch, edge: float | None, seconds: np.ndarray | None = None) -> list[Column]:
    """Columns of the audit and of the solver: penetration over the mesh's ``edge`` [m], and the time of each frame (T,)
    [s]."""
    audit, deep = touch.audit, touch.audit["penetration"]
    out = [Column("balance", audit["force_balance"], ".1e")]
    if "min_det_f" in audit:
        out.append(Column("min det F", audit["min_det_f"], ".3f"))
    if "mesh_error" in audit:
        out.append(Column("mesh err %", 100.0 * audit["mesh_error"], ".1f"))
    out += [Column("energy J", audit["energy"], ".2e"),
            Column("penetr. mm", 1e3 * deep, ".3f") if edge is None else Column("penetr. %", 100 * deep / edge, ".2g"),
            Column("residual", touch.residual, ".1e"), Column("iterations", touch.iterations, "d")]
    return out if seconds is None else [*out, Column("s", seconds, ".2f")]


def recorded(touch: Touch) -> dict[str, tuple[np.ndarray, str]]:
    """Everything that a dataset would hold of the touch, by the names of the schema, with shape, unit and meaning."""
    out: dict[str, tuple[np.ndarray, str]] = {}
    for row in FIELDS:
        name = row.path.rpartition("/")[2]
        if row.group == "touches/*" and name not in ("time", "reason_names") and (
                value := touch.channel(name)) is not None:
            out[name] = (np.asarray(value), f"({row.dims_text}) [{row.unit}]: {row.doc}")
    return out


def direction(spec: PressSpec) -> np.ndarray:
    """Unit direction (3,) of the first part of the path that goes anywhere; down for a turn on the spot."""
    for a, b in zip(spec.path[:-1], spec.path[1:], strict=True):
        if a != b:
            way = np.array(b) - np.array(a)
            return way / np.linalg.norm(way)
    return np.array([0.0, 0.0, -1.0])


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
