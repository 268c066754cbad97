"""What a dataset holds, as Python objects: a view, its touches, and the truth behind them.

Arrays are numpy; lengths are metres, forces newtons, in the world frame (z up) unless a field says otherwise.
The letters in the shapes: H, W image height and width; T frames of a touch; N nodes of the simulated
object; M elements (or samples) of the truth; P probed surface points; n VSF particles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.interactive.html_table import html_table
from vsfsim.core.shape import ProbeShape

AUDIT_COLUMNS = ("force_balance", "min_det_f", "energy", "penetration")
"""Columns of `Touch.audit` that every simulated touch has; see there for the units."""
CONTACT_COLUMNS = ("contact_points", "contact_radius")
"""Further columns of a touch by a rigid probe."""
MESH_COLUMNS = ("mesh_error", "corner_det_f", "rotation")
"""Further columns of a touch by a rigid probe on a solid of tetrahedra."""


@dataclass(frozen=True, repr=False)
class View:
    """One RGB-D image of the object at rest."""

    rgb: np.ndarray
    """Colour, sRGB (H, W, 3) uint8 [0..255]."""
    depth: np.ndarray
    """Distance along the optical axis (z-depth), 0 where there is no object (H, W) float32 [m]."""
    mask: np.ndarray
    """True on the object (H, W) bool."""
    intrinsics: np.ndarray
    """Pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; the centre of the top-left pixel is (0, 0) (3, 3) [px]."""
    camera_pose: np.ndarray
    """Camera-to-world transform, OpenCV axes (x right, y down, z forward) (4, 4) [m]."""

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

    time: np.ndarray
    """Of each frame (T,) [s]."""
    mount_pose: np.ndarray
    """Probe-to-world transform, the origin being the probe's reference point (T, 4, 4) [m]. Where a spring carries the
    probe, that of its mount: where the probe would be without a force."""
    axis: np.ndarray
    """Unit direction of the press, world (3,) [-]."""
    target: np.ndarray
    """The visible point that was aimed at, world (3,) [m]."""
    normal: np.ndarray
    """Outward unit normal of the visible cloud at the target, world (3,) [-]."""
    force: np.ndarray
    """On the probe, world (T, 3) [N]."""
    reaction: np.ndarray
    """Of the object's supports on the object, world (T, 3) [N]."""
    converged: np.ndarray
    """The frame is an equilibrium within the solver's tolerance (T,) bool."""
    residual: np.ndarray
    """Relative residual of the equilibrium (T,) [-]."""
    iterations: np.ndarray
    """Newton iterations of the frame (T,) int."""
    touched: bool
    """The probe met the object in at least one frame."""
    reason: np.ndarray
    """0 for a good frame, else an index + 1 into `reason_names` (T,) int."""
    reason_names: tuple[str, ...] = ()
    """What the codes of `reason` mean, one sentence each."""
    resolved: np.ndarray | None = None
    """The frame is an equilibrium, and the mesh resolves its contact and the parts inside (T,) bool; None where that is
    not measured."""
    audit: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Columns by name, each (T,): force_balance = |force - reaction - weight| over the larger norm [-]; min_det_f =
    smallest det F of an element [-]; energy = elastic energy of the object [J]; penetration = deepest point of the
    surface inside the probe, between the contact points too [m]. Of a rigid probe also contact_points = number of
    points in contact, and contact_radius = radius of a circle of the area in contact over the edge of the elements
    there [-]. On a solid of tetrahedra also mesh_error = estimated error of the force because the contact is small
    against the elements [-], corner_det_f = least det F at the corners of the tetrahedra in contact [-], and rotation
    = largest rotation of a tetrahedron [rad]. Of an audited touch also finer_force = force of the same touch on a mesh
    one level finer, world (T, 3) [N]; finer_converged = bool, the frame is an equilibrium there [-]."""
    q: np.ndarray | None = None
    """Joint angles of the arm (T, 7) [rad], or None without an arm."""
    torque: np.ndarray | None = None
    """Joint torques due to the contact (T, 7) [N m], or None without an arm."""
    link_force: np.ndarray | None = None
    """Contact force on each of the arm's L links, world (T, L, 3) [N], or None without an arm."""
    link_moment: np.ndarray | None = None
    """Contact moment on each about the origin of its frame, world (T, L, 3) [N m], or None without an arm."""
    draws: int | None = None
    """Targets drawn until the arm could reach one [-], or None without an arm."""
    ended: int | None = None
    """Why a guarded touch has fewer readings than planned [-]: 0 it has them all, 1 the arm's protective stop on its
    way back, 2 the solver's iterations were used up; None for other touches."""
    planned_time: np.ndarray | None = None
    """Of each of the G frames that were planned (G,) [s]; this and the next three are None where the plan is not
    kept."""
    planned_pose: np.ndarray | None = None
    """Probe-to-world transforms of the plan (G, 4, 4) [m]."""
    planned_q: np.ndarray | None = None
    """Joint angles of the plan (G, 7) [rad]."""
    planned_frame: np.ndarray | None = None
    """The frame of the plan in which each frame was read (T,) int; -1 where the arm had left its plan, because the
    force limit was met."""
    mount_stiffness: float | None = None
    """Of the spring along the press that carries the probe [N/m]; None for a rigid mount."""
    press: int | None = None
    """Which kind of press it is where a scene has several: 0 for its own, k for the k-th of its ``[[touches.other]]``;
    else None."""
    pressure: np.ndarray | None = None
    """Gauge pressure of the bubble (T,) [Pa]; None for a rigid probe."""
    rest_pressure: float | None = None
    """Gauge pressure of its free dome [Pa]; None for a rigid probe."""
    moment: np.ndarray | None = None
    """Of the contact force on the sensor about the mount's origin, world (T, 3) [N m]; None for a rigid probe."""
    node_position: np.ndarray | None = None
    """Sensor read-out vertices, world (T, N, 3) [m]; None if not kept."""
    node_force: np.ndarray | None = None
    """Contact force on each read-out vertex, world (T, N, 3) [N]; None if not kept."""
    node_rest: np.ndarray | None = None
    """Read-out vertices of the free dome, mount frame (N, 3) [m]; None if not kept."""
    node_reference: np.ndarray | None = None
    """Their coordinates on the stress-free skin (N, 2) [m]; None if not kept."""
    node_triangles: np.ndarray | None = None
    """Of the read-out mesh, wound outwards (F, 3) int; None if not kept."""
    fine_position: np.ndarray | None = None
    """Vertices of the mesh that was solved, world (T, V, 3) [m]; None if not kept."""
    fine_force: np.ndarray | None = None
    """Contact force on each of them, world (T, V, 3) [N]; None if not kept."""
    fine_rest: np.ndarray | None = None
    """The same vertices of the free dome, mount frame (V, 3) [m]; None if not kept."""
    fine_triangles: np.ndarray | None = None
    """Of that mesh, wound outwards (K, 3) int; None if not kept."""
    inside_depth: np.ndarray | None = None
    """Depth image of the camera in the bubble: distance along its axis, 0 where there is no skin (T, h, w) [m]; None
    if not kept."""
    inside_rgb: np.ndarray | None = None
    """Colour image of the same camera (T, h, w, 3) uint8 sRGB; None if not kept."""
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


@dataclass(frozen=True, repr=False)
class Truth:
    """Ground truth, which no method may read."""

    points: np.ndarray
    """Centroid of each element at rest, world (M, 3) [m]."""
    young_modulus: np.ndarray
    """At each centroid (M,) [Pa]."""
    region: np.ndarray
    """Of each element, an index into `region_names` (M,) int."""
    region_names: tuple[str, ...]
    """Names of the object's parts (R,)."""
    probe_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Surface points where the small cone was pressed, world (P, 3) [m]; empty if not measured."""
    probe_normals: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Outward unit normals there, world (P, 3) [-]."""
    probe_stiffness: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Force of the cone over its displacement, SBML appendix C.4 (P,) [N/m]."""
    vsf_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Particles of the oracle VSF, world (n, 3) [m]; empty if not fitted."""
    vsf_stiffness: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Spring constant of each particle, fitted to exhaustive noise-free touches (n,) [N/m]."""
    vsf_touched: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """The particle was displaced by at least one of those touches (n,) bool."""
    radius: np.ndarray | None = None
    """Of a plant's segments, half the thickness of a blade (M,) [m]; None for a solid."""
    half_width: np.ndarray | None = None
    """Of a blade's segments, 0 for a round one (M,) [m]; None for a solid."""
    segment_ends: np.ndarray | None = None
    """Of a plant's segments on its middle line, world (M, 2, 3) [m]; None for a solid."""
    notes: tuple[str, ...] | None = None
    """What the object is, and why others were drawn before it, one sentence each; None if not recorded."""

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
