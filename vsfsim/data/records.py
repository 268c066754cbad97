"""What a dataset holds, as Python objects: a view, its touches, and the truth behind them.

Arrays are numpy; lengths are metres, forces newtons, in the world frame (z up) unless a field says otherwise. The rows
of `schema.md` say what the fields of `View`, `Touch` and `Truth` are; None, where a field may be, says that it was not
recorded. The letters in the shapes: H, W image height and width; T frames of a touch; N nodes of the simulated object;
M elements (or samples) of the truth; P probed surface points; n VSF particles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.shape import ProbeShape
from vsfsim.core.system.interactive import html_table

AUDIT_COLUMNS = ("force_balance", "min_det_f", "energy", "penetration")
"""Those that every simulated touch has."""
CONTACT_COLUMNS = ("contact_points", "contact_radius")
"""Further columns of a touch by a rigid probe."""
MESH_COLUMNS = ("mesh_error", "corner_det_f", "rotation")
"""Further columns of a touch by a rigid probe on a solid of tetrahedra."""


def values_of(record: View | Touch | Truth) -> dict[str, Any]:
    """What a record holds by the names of the schema's rows, ``audit/NAME`` and ``channels/NAME`` among them; what it
    does not hold is left out."""
    out: dict[str, Any] = {}
    for one in fields(record):
        value = getattr(record, one.name)
        if isinstance(value, Mapping):
            out |= {f"{one.name}/{name}": column for name, column in value.items()}
        elif value is not None:
            out[one.name] = value
    return out


_NO_POINTS, _NO_NUMBERS, _NO_MARKS = partial(np.zeros, (0, 3)), partial(np.zeros, 0), partial(np.zeros, 0, bool)


@dataclass(frozen=True, repr=False)
class View:
    """One RGB-D image of the object at rest."""

    rgb: np.ndarray  # (H, W, 3) [-]
    depth: np.ndarray  # (H, W) [m]
    mask: np.ndarray  # (H, W) [-]
    intrinsics: np.ndarray  # (3, 3) [px]
    camera_pose: np.ndarray  # (4, 4) [m]

    def points(self) -> np.ndarray:
        """The visible cloud (k, 3) [m]: one world point a masked pixel, in row-major pixel order."""
        row, column = np.nonzero(self.mask)
        depth = self.depth[row, column].astype(np.float64)
        ray = np.linalg.solve(self.intrinsics, np.stack([column, row, np.ones_like(row)]).astype(np.float64))
        return (ray * depth).T @ self.camera_pose[:3, :3].T + self.camera_pose[:3, 3]

    def __repr__(self) -> str:
        height, width = self.mask.shape
        return f"View({width} x {height} pixels, {int(np.count_nonzero(self.mask))} on the object)"


@dataclass(frozen=True, repr=False)
class Touch:
    """One press of T frames: free approach, in, hold and out again."""

    time: np.ndarray  # (T,) [s]
    mount_pose: np.ndarray  # (T, 4, 4) [m]
    axis: np.ndarray  # (3,) [-]
    target: np.ndarray  # (3,) [m]
    normal: np.ndarray  # (3,) [-]
    force: np.ndarray  # (T, 3) [N]
    reaction: np.ndarray  # (T, 3) [N]
    converged: np.ndarray  # (T,) [-]
    residual: np.ndarray  # (T,) [-]
    iterations: np.ndarray  # (T,) [-]
    touched: bool  # [-]
    reason: np.ndarray  # (T,) [-]
    reason_names: tuple[str, ...] = ()  # (Q,) [-]
    audit: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Columns by name, each (T, ...): the rows ``audit/NAME`` of the schema."""
    resolved: np.ndarray | None = None  # (T,) [-]
    q: np.ndarray | None = None  # (T, 7) [rad]
    torque: np.ndarray | None = None  # (T, 7) [N m]
    link_force: np.ndarray | None = None  # (T, L, 3) [N]
    link_moment: np.ndarray | None = None  # (T, L, 3) [N m]
    draws: int | None = None  # [-]
    planned_time: np.ndarray | None = None  # (G,) [s]
    planned_pose: np.ndarray | None = None  # (G, 4, 4) [m]
    planned_q: np.ndarray | None = None  # (G, 7) [rad]
    planned_frame: np.ndarray | None = None  # (T,) [-]
    mount_stiffness: float | None = None  # [N/m]
    press: int | None = None  # [-]
    pressure: np.ndarray | None = None  # (T,) [Pa]
    rest_pressure: float | None = None  # [Pa]
    moment: np.ndarray | None = None  # (T, 3) [N m]
    node_position: np.ndarray | None = None  # (T, N, 3) [m]
    node_force: np.ndarray | None = None  # (T, N, 3) [N]
    node_rest: np.ndarray | None = None  # (N, 3) [m]
    node_reference: np.ndarray | None = None  # (N, 2) [m]
    node_triangles: np.ndarray | None = None  # (F, 3) [-]
    fine_position: np.ndarray | None = None  # (T, V, 3) [m]
    fine_force: np.ndarray | None = None  # (T, V, 3) [N]
    fine_rest: np.ndarray | None = None  # (V, 3) [m]
    fine_triangles: np.ndarray | None = None  # (K, 3) [-]
    inside_depth: np.ndarray | None = None  # (T, h, w) [m]
    inside_rgb: np.ndarray | None = None  # (T, h, w, 3) [-]
    channels: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Readings of sensors that have no field of their own here, by name: the rows ``channels/NAME`` of the schema."""

    def channel(self, name: str) -> Any:
        """What the touch holds under the name of a schema row's field, audit column or channel; None if it does not."""
        found = getattr(self, name, None)
        return self.channels.get(name, self.audit.get(name)) if found is None else found

    def probe_pose(self) -> np.ndarray:
        """Where the probe itself was, transforms to the world (T, 4, 4) [m]; its mount's in frames without a force."""
        out = self.mount_pose.copy()
        if self.mount_stiffness is not None:
            give = np.nan_to_num(self.normal_force()) / self.mount_stiffness
            out[:, :3, 3] -= give[:, None] * self.axis
        return out

    def normal_force(self) -> np.ndarray:
        """Force of the object on the probe against the press direction (T,) [N]; positive when it pushes back."""
        return -(self.force @ self.axis)

    def __repr__(self) -> str:
        good = np.asarray(self.converged, bool)
        most = float(self.normal_force()[good].max(initial=0.0))
        return (f"Touch({len(self.time)} frames, {int((~good).sum())} not converged, "
                f"{f'normal force up to {most:.3g} N' if self.touched else 'no contact'})")


@dataclass(frozen=True, repr=False, kw_only=True)
class Truth:
    """Ground truth, which no method may read. Of an object whose touches were not simulated, or not probed, arrays are
    empty."""

    points: np.ndarray  # (M, 3) [m]
    young_modulus: np.ndarray  # (M,) [Pa]
    radius: np.ndarray | None = None  # (M,) [m]
    half_width: np.ndarray | None = None  # (M,) [m]
    segment_ends: np.ndarray | None = None  # (M, 2, 3) [m]
    region: np.ndarray  # (M,) [-]
    region_names: tuple[str, ...]  # (R,) [-]
    notes: tuple[str, ...] | None = None  # (S,) [-]
    probe_points: np.ndarray = field(default_factory=_NO_POINTS)  # (P, 3) [m]
    probe_normals: np.ndarray = field(default_factory=_NO_POINTS)  # (P, 3) [-]
    probe_stiffness: np.ndarray = field(default_factory=_NO_NUMBERS)  # (P,) [N/m]
    probe_error: np.ndarray | None = None  # (P,) [N/m]
    vsf_points: np.ndarray = field(default_factory=_NO_POINTS)  # (n, 3) [m]
    vsf_stiffness: np.ndarray = field(default_factory=_NO_NUMBERS)  # (n,) [N/m]
    vsf_touched: np.ndarray = field(default_factory=_NO_MARKS)  # (n,) [-]

    def __repr__(self) -> str:
        modulus = self.young_modulus
        span = f"E {modulus.min():.3g} to {modulus.max():.3g} Pa" if modulus.size else "no elements"
        return f"Truth({len(self.points)} elements, {span}, regions: {', '.join(self.region_names)})"


@dataclass(frozen=True, repr=False)
class ObjectView:
    """One view of an object and the touches of it: one file of a dataset."""

    name: str
    """Unique in its dataset, e.g. "shoe-0007-v0"."""
    object_index: int
    """From 0."""
    view_index: int
    """Of the view of that object, from 0."""
    split: str
    """"train", "test", ... as the scene names them."""
    probe: ProbeShape
    """The rigid shape that touched it, the chain of an arm, or the free dome of a bubble."""
    view: View
    """The RGB-D image at rest."""
    touches: tuple[Touch, ...]
    """In the order in which they were made."""
    truth: Truth | None
    """None where it is withheld (a blind dataset)."""
    others: tuple[ProbeShape, ...] = ()
    """What made the presses of other kinds, the first that of `Touch.press` 1."""

    @property
    def probes(self) -> tuple[ProbeShape, ...]:
        """What touched it, by `Touch.press`."""
        return self.probe, *self.others

    def probe_of(self, touch: Touch) -> ProbeShape:
        """What made a touch of it."""
        return self.probes[touch.press or 0]

    def __repr__(self) -> str:
        return (f"ObjectView({self.name!r}, {self.split}, {len(self.touches)} touches"
                f"{'' if self.truth is not None else ', truth withheld'})")

    def _repr_html_(self) -> str:
        rows = [(k, len(t.time), int((~np.asarray(t.converged, bool)).sum()), "yes" if t.touched else "no",
                 f"{float(t.normal_force()[np.asarray(t.converged, bool)].max(initial=0.0)):.3g}")
                for k, t in enumerate(self.touches)]
        return html_table(f"{self!r}; {self.view!r}",
                          ("touch", "frames", "not converged", "contact", "largest normal force [N]"), rows)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw its picture, depth, touched points and force over travel; returns the `matplotlib.figure.Figure`.

        Args:
            path: PNG to write, or None.
        """
        from vsfsim.data.contact_sheet import contact_sheet

        return contact_sheet([self], path)
