"""What a dataset holds, as Python objects: a view, its touches, and the truth behind them.

Arrays are numpy; lengths are metres, forces newtons, in the world frame (z up) unless a field says otherwise.
The letters in the shapes: H, W image height and width; T frames of a touch; N nodes of the simulated
object; M elements (or samples) of the truth; P probed surface points; n VSF particles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.core.shape import ProbeShape

REASON_OK = 0
"""`Touch.reason` of a frame with nothing to complain about."""

AUDIT_COLUMNS = ("force_balance", "min_det_f", "energy", "penetration")
"""Columns of `Touch.audit` that every simulated touch has; see there for the units."""


@dataclass(frozen=True)
class View:
    """One RGB-D image of the object at rest.

    rgb: colour, sRGB (H, W, 3) uint8 [0..255].
    depth: distance along the optical axis (z-depth), 0 where there is no object (H, W) float32 [m].
    mask: True on the object (H, W) bool.
    intrinsics: pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; the centre of the top-left pixel is
        (0, 0) (3, 3) [px].
    camera_pose: camera-to-world transform, OpenCV axes (x right, y down, z forward) (4, 4) [m].
    """

    rgb: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    intrinsics: np.ndarray
    camera_pose: np.ndarray

    def points(self) -> np.ndarray:
        """The visible cloud (k, 3) [m]: one world point a masked pixel, in row-major pixel order."""
        row, column = np.nonzero(self.mask)
        depth = self.depth[row, column].astype(np.float64)
        ray = np.linalg.solve(self.intrinsics, np.stack([column, row, np.ones_like(row)]).astype(np.float64))
        return (ray * depth).T @ self.camera_pose[:3, :3].T + self.camera_pose[:3, 3]


@dataclass(frozen=True)
class Touch:
    """One press: free approach, in, hold and out again, T frames.

    time: of each frame (T,) [s].
    mount_pose: probe-to-world transform, the origin being the probe's reference point (T, 4, 4) [m].
    axis: unit direction of the press, world (3,) [-].
    target: the visible point that was aimed at, world (3,) [m].
    normal: outward unit normal of the visible cloud at the target, world (3,) [-].
    force: on the probe, world (T, 3) [N].
    reaction: of the object's supports on the object, world (T, 3) [N].
    converged: the frame is an equilibrium within the solver's tolerance (T,) bool.
    residual: relative residual of the equilibrium (T,) [-].
    iterations: Newton iterations spent on the frame (T,) int.
    touched: the probe met the object in at least one frame.
    reason: 0 for a good frame, else an index + 1 into `reason_names` (T,) int.
    reason_names: what the codes of `reason` mean, one sentence each.
    audit: columns by name, each (T,): force_balance = |force - reaction - weight| over the larger norm [-];
        min_det_f = smallest det F of an element [-]; energy = elastic energy of the object [J];
        penetration = deepest quadrature point of the surface inside the probe [m].
    q: joint angles of the arm (T, 7) [rad], or None without an arm.
    torque: joint torques due to the contact (T, 7) [N m], or None without an arm.
    link_force: contact force on each of the arm's L links, world (T, L, 3) [N], or None without an arm.
    link_moment: contact moment on each about the origin of its frame, world (T, L, 3) [N m], or None without an arm.
    draws: how many targets were drawn until the arm could reach one [-], or None without an arm.
    ended: why a guarded touch has fewer readings than planned [-], or None for others: 0 it has them all, 1 the arm's
    protective stop on its way back, 2 the solver's iterations were used up.
    pressure: gauge pressure of the bubble (T,) [Pa], or None for a rigid probe.
    rest_pressure: that of its free dome, a number [Pa], or None for a rigid probe.
    moment: of the contact force on the sensor about the mount's origin, world (T, 3) [N m], or None for a rigid probe.
    node_position: sensor read-out vertices, world (T, N, 3) [m], or None if not kept.
    node_force: contact force on each read-out vertex, world (T, N, 3) [N], or None if not kept.
    node_rest: read-out vertices of the free dome, mount frame (N, 3) [m], or None if not kept.
    node_reference: their coordinates on the stress-free skin (N, 2) [m], or None if not kept.
    node_triangles: of the read-out mesh, wound outwards (F, 3) int, or None if not kept.
    fine_position: vertices of the mesh that was solved, world (T, V, 3) [m], or None if not kept.
    fine_force: contact force on each of them, world (T, V, 3) [N], or None if not kept.
    fine_rest: the same vertices of the free dome, mount frame (V, 3) [m], or None if not kept.
    fine_triangles: of that mesh, wound outwards (K, 3) int, or None if not kept.
    inside_depth: what the camera in the bubble sees, distance along its axis, 0 where there is no skin (T, h, w) [m],
    or None if not kept.
    inside_rgb: colour of the same (T, h, w, 3) uint8 sRGB, or None if not kept.
    """

    time: np.ndarray
    mount_pose: np.ndarray
    axis: np.ndarray
    target: np.ndarray
    normal: np.ndarray
    force: np.ndarray
    reaction: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    touched: bool
    reason: np.ndarray
    reason_names: tuple[str, ...] = ()
    audit: Mapping[str, np.ndarray] = field(default_factory=dict)
    q: np.ndarray | None = None
    torque: np.ndarray | None = None
    link_force: np.ndarray | None = None
    link_moment: np.ndarray | None = None
    draws: int | None = None
    ended: int | None = None
    pressure: np.ndarray | None = None
    rest_pressure: float | None = None
    moment: np.ndarray | None = None
    node_position: np.ndarray | None = None
    node_force: np.ndarray | None = None
    node_rest: np.ndarray | None = None
    node_reference: np.ndarray | None = None
    node_triangles: np.ndarray | None = None
    fine_position: np.ndarray | None = None
    fine_force: np.ndarray | None = None
    fine_rest: np.ndarray | None = None
    fine_triangles: np.ndarray | None = None
    inside_depth: np.ndarray | None = None
    inside_rgb: np.ndarray | None = None
    channels: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Readings of sensors that have no field of their own here, by name: the rows ``channels/NAME`` of the schema."""

    def channel(self, name: str) -> Any:
        """What the touch holds under the name of a schema row's field, audit column or channel; None if it does not."""
        found = getattr(self, name, None)
        return self.channels.get(name, self.audit.get(name)) if found is None else found

    def normal_force(self) -> np.ndarray:
        """Force of the object on the probe against the press direction (T,) [N]; positive when it pushes back."""
        return -(self.force @ self.axis)


@dataclass(frozen=True)
class Truth:
    """What no method may see.

    points: centroid of each element at rest, world (M, 3) [m].
    young_modulus: at each centroid (M,) [Pa].
    region: of each element, an index into `region_names` (M,) int.
    region_names: names of the object's parts (R,).
    probe_points: surface points where the small cone was pressed, world (P, 3) [m]; empty if not measured.
    probe_normals: outward unit normals there, world (P, 3) [-].
    probe_stiffness: force of the cone over its displacement, SBML appendix C.4 (P,) [N/m].
    vsf_points: particles of the oracle VSF, world (n, 3) [m]; empty if not fitted.
    vsf_stiffness: spring constant of each particle, fitted to exhaustive noise-free touches (n,) [N/m].
    vsf_touched: the particle was displaced by at least one of those touches (n,) bool.
    radius: of a plant's segments, half the thickness of a blade (M,) [m], or None for a solid.
    half_width: of a blade's segments, 0 for a round one (M,) [m], or None for a solid.
    segment_ends: of a plant's segments on its middle line, world (M, 2, 3) [m], or None for a solid.
    """

    points: np.ndarray
    young_modulus: np.ndarray
    region: np.ndarray
    region_names: tuple[str, ...]
    probe_points: np.ndarray
    probe_normals: np.ndarray
    probe_stiffness: np.ndarray
    vsf_points: np.ndarray
    vsf_stiffness: np.ndarray
    vsf_touched: np.ndarray
    radius: np.ndarray | None = None
    half_width: np.ndarray | None = None
    segment_ends: np.ndarray | None = None


@dataclass(frozen=True)
class ObjectView:
    """One object seen once and touched many times: one file of a dataset.

    name: e.g. "shoe-0007-v0"; unique in its dataset. object_index: of the object, from 0 [-].
    view_index: of the view of that object, from 0 [-]. split: "train", "test", ... as the scene names them.
    probe: the rigid shape that touched it, the chain of an arm, or the free dome of a bubble. view: the RGB-D image at
    rest. touches: in the order they were made.
    truth: None where it is withheld (a blind dataset).
    """

    name: str
    object_index: int
    view_index: int
    split: str
    probe: ProbeShape
    view: View
    touches: tuple[Touch, ...]
    truth: Truth | None
