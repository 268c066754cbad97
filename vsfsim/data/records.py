"""What a dataset holds, as Python objects: a view, its touches, and the truth behind them.

Arrays are numpy; lengths are metres, forces newtons, in the world frame (z up) unless a field says otherwise. The row
of a field says its shape, its unit and what it is; None, where a field may be, says that it was not recorded. The
letters in the shapes: H, W image height and width; T frames of a touch; N nodes of the simulated
object; M elements (or samples) of the truth; P probed surface points; n VSF particles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from vsfsim.core.shape import ProbeShape
from vsfsim.core.system.interactive import html_table

TEXT = "text"
"""dtype of a row of strings: UTF-8, padded with zero bytes to the longest."""


@dataclass(frozen=True)
class Row:
    """What the file says of a field: the schema (`vsfsim.data.schema`) is made of these."""

    dtype: str
    """NumPy name, or `TEXT`."""
    dims: str
    """Lengths or letters with a space between, outermost first; "" for a single number."""
    unit: str
    """Of the stored numbers; "1" is dimensionless."""
    doc: str
    """One sentence."""
    masked: bool = False
    """Along T, only the rows of converged frames must be finite."""
    optional: bool = False
    """Whether it may be missing; a field of a record may if it is None by default."""


AUDIT = {
    "force_balance": Row("float64", "T", "1",
        "Norm of force - reaction - weight, over the larger norm; 0 in perfect balance. Of plants: "
        "over 0.1 N at least.", masked=True),
    "min_det_f": Row("float64", "T", "1",
        "Smallest det F of an element; not of a plant, whose beams have none.", masked=True, optional=True),
    "energy": Row("float64", "T", "J",
        "Elastic energy of the object; with a bubble, of object, skin and air.", masked=True),
    "penetration": Row("float64", "T", "m",
        "Deepest point of the surface inside the probe, between the contact points too; of a "
        "bubble, deepest node of either surface inside the other.", masked=True),
    "contact_points": Row("int64", "T", "1",
        "Number of contact points that touch; of a rigid probe.", optional=True),
    "contact_radius": Row("float64", "T", "1",
        "How well the contact is resolved: radius of a circle of its area over the edge of the "
        "elements there; of a rigid probe.", optional=True),
    "mesh_error": Row("float64", "T", "1",
        "Estimated error of the force by the size of the elements; of a rigid probe on tetrahedra.",
        masked=True, optional=True),
    "corner_det_f": Row("float64", "T", "1",
        "Smallest det F at the corners of the tetrahedra in contact; of a rigid probe on "
        "tetrahedra.", masked=True, optional=True),
    "rotation": Row("float64", "T", "rad",
        "Largest rotation of a tetrahedron; of a rigid probe on tetrahedra.", masked=True, optional=True),
    "finer_force": Row("float64", "T 3", "N",
        "Force of the same touch on a mesh one level finer, world, 0 where finer_converged is not; "
        "of one touch in ten of a dataset with --accuracy.", optional=True),
    "finer_converged": Row("bool", "T", "1",
        "The frame is an equilibrium on the finer mesh.", optional=True),
}
"""Columns of `Touch.audit`."""
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

    rgb: Annotated[np.ndarray, Row("uint8", "H W 3", "1",
        "Colour image of the object at rest, sRGB, 0 to 255.")]
    depth: Annotated[np.ndarray, Row("float32", "H W", "m",
        "Distance along the optical axis; 0 where there is no object.")]
    mask: Annotated[np.ndarray, Row("bool", "H W", "1", "True on the object.")]
    intrinsics: Annotated[np.ndarray, Row("float64", "3 3", "px",
        "Pinhole matrix; the centre of the top-left pixel is (0, 0).")]
    camera_pose: Annotated[np.ndarray, Row("float64", "4 4", "m",
        "Camera-to-world transform, OpenCV axes; its rotation part has no unit.")]

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

    time: Annotated[np.ndarray, Row("float64", "T", "s", "Time of each frame.")]
    mount_pose: Annotated[np.ndarray, Row("float64", "T 4 4", "m",
        "Probe-to-world transform, of the probe's mount where a spring carries it; its rotation "
        "part has no unit.")]
    axis: Annotated[np.ndarray, Row("float64", "3", "1", "Unit direction of the press, world.")]
    target: Annotated[np.ndarray, Row("float64", "3", "m",
        "The visible point that was aimed at, world.")]
    normal: Annotated[np.ndarray, Row("float64", "3", "1",
        "Outward unit normal of the visible cloud at the target, world.")]
    force: Annotated[np.ndarray, Row("float64", "T 3", "N",
        "Contact force on the probe, world, free of sensor noise.", masked=True)]
    reaction: Annotated[np.ndarray, Row("float64", "T 3", "N",
        "Force of the supports on the object, world; equals force where the object weighs nothing.", masked=True)]
    converged: Annotated[np.ndarray, Row("bool", "T", "1",
        "The frame is an equilibrium within the solver's tolerance.")]
    residual: Annotated[np.ndarray, Row("float64", "T", "1",
        "Relative residual of the equilibrium.", masked=True)]
    iterations: Annotated[np.ndarray, Row("int64", "T", "1",
        "Newton iterations spent on the frame.")]
    touched: Annotated[bool, Row("bool", "", "1",
        "The probe met the object in at least one frame.")]
    reason: Annotated[np.ndarray, Row("int64", "T", "1",
        "0 for a good frame, else 1 + an index into reason_names.")]
    reason_names: Annotated[tuple[str, ...], Row("text", "Q", "1",
        "What the codes of reason mean.")] = ()
    audit: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Columns by name, each (T, ...): those of `AUDIT`."""
    resolved: Annotated[np.ndarray | None, Row("bool", "T", "1",
        "The frame is an equilibrium, its mesh_error is 0.115 at most, no corner of an element is "
        "inside out, at a tier of small strain none turns by more than 0.13 rad, and the mesh "
        "holds the parts inside; of a rigid probe on tetrahedra.")] = None
    q: Annotated[np.ndarray | None, Row("float64", "T 7", "rad", "Joint angles of the arm.")] = None
    torque: Annotated[np.ndarray | None, Row("float64", "T 7", "N m",
        "Joint torques due to the contact.", masked=True)] = None
    link_force: Annotated[np.ndarray | None, Row("float64", "T L 3", "N",
        "Contact force on each link of the arm, world.", masked=True)] = None
    link_moment: Annotated[np.ndarray | None, Row("float64", "T L 3", "N m",
        "Contact moment on each link about the origin of its frame, world.", masked=True)] = None
    draws: Annotated[int | None, Row("int64", "", "1",
        "How many targets were drawn until the arm could reach one.")] = None
    ended: Annotated[int | None, Row("int64", "", "1",
        "Why a guarded touch has fewer readings than planned: 0 it has them all, 1 the arm's "
        "protective stop on its way back, 2 the solver's iterations were used up.")] = None
    planned_time: Annotated[np.ndarray | None, Row("float64", "G", "s",
        "Time of each frame of the planned touch; kept if [touches] says plan = true.")] = None
    planned_pose: Annotated[np.ndarray | None, Row("float64", "G 4 4", "m",
        "Probe-to-world transform of the plan.")] = None
    planned_q: Annotated[np.ndarray | None, Row("float64", "G 7", "rad",
        "Joint angles of the plan.")] = None
    planned_frame: Annotated[np.ndarray | None, Row("int64", "T", "1",
        "The frame of the plan in which a frame was read; -1 where the arm had left its plan at "
        "the force limit.")] = None
    mount_stiffness: Annotated[float | None, Row("float64", "", "N/m",
        "Of the spring along the press that carries the probe.")] = None
    press: Annotated[int | None, Row("int64", "", "1",
        "Kind of the press where the scene has several: 0 its own, k the k-th of its "
        "[[touches.other]].")] = None
    pressure: Annotated[np.ndarray | None, Row("float64", "T", "Pa",
        "Gauge pressure of the bubble.", masked=True)] = None
    rest_pressure: Annotated[float | None, Row("float64", "", "Pa",
        "Gauge pressure of the free dome.")] = None
    moment: Annotated[np.ndarray | None, Row("float64", "T 3", "N m",
        "Moment of the contact force on the sensor about the mount's origin, world.", masked=True)] = None
    node_position: Annotated[np.ndarray | None, Row("float32", "T N 3", "m",
        "Sensor read-out vertices, world.", masked=True)] = None
    node_force: Annotated[np.ndarray | None, Row("float32", "T N 3", "N",
        "Contact force on each read-out vertex, world.", masked=True)] = None
    node_rest: Annotated[np.ndarray | None, Row("float64", "N 3", "m",
        "Read-out vertices of the free dome, mount frame.")] = None
    node_reference: Annotated[np.ndarray | None, Row("float64", "N 2", "m",
        "Coordinates of the read-out vertices on the stress-free skin.")] = None
    node_triangles: Annotated[np.ndarray | None, Row("int64", "F 3", "1",
        "Triangles of the read-out mesh, wound outwards.")] = None
    fine_position: Annotated[np.ndarray | None, Row("float32", "T V 3", "m",
        "Vertices of the mesh that was solved, world; kept if [sensor] says fine = true.", masked=True)] = None
    fine_force: Annotated[np.ndarray | None, Row("float32", "T V 3", "N",
        "Contact force on each of them, world.", masked=True)] = None
    fine_rest: Annotated[np.ndarray | None, Row("float64", "V 3", "m",
        "The same vertices of the free dome, mount frame.")] = None
    fine_triangles: Annotated[np.ndarray | None, Row("int64", "K 3", "1",
        "Triangles of that mesh, wound outwards.")] = None
    inside_depth: Annotated[np.ndarray | None, Row("float32", "T h w", "m",
        "What the camera in the bubble sees: distance along its axis; 0 where there is no skin.", masked=True)] = None
    inside_rgb: Annotated[np.ndarray | None, Row("uint8", "T h w 3", "1",
        "Colour image of the same, sRGB, 0 to 255.")] = None
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

    points: Annotated[np.ndarray, Row("float64", "M 3", "m",
        "Centroid of each element at rest, world.")]
    young_modulus: Annotated[np.ndarray, Row("float64", "M", "Pa",
        "Young's modulus at each centroid.")]
    radius: Annotated[np.ndarray | None, Row("float64", "M", "m",
        "Of a plant's segment; half the thickness of a leaf blade.")] = None
    half_width: Annotated[np.ndarray | None, Row("float64", "M", "m",
        "Of a leaf blade's segment, 0 for a round one.")] = None
    segment_ends: Annotated[np.ndarray | None, Row("float64", "M 2 3", "m",
        "Ends of a plant's segments on its middle line, world.")] = None
    region: Annotated[np.ndarray, Row("int64", "M", "1",
        "Region of each element, an index into region_names.")]
    region_names: Annotated[tuple[str, ...], Row("text", "R", "1", "Names of the object's parts.")]
    notes: Annotated[tuple[str, ...] | None, Row("text", "S", "1",
        "What the object is, and why others were drawn before it, one sentence each.")] = None
    probe_points: Annotated[np.ndarray, Row("float64", "P 3", "m",
        "Surface points where the small cone was pressed, world.")] = field(default_factory=_NO_POINTS)
    probe_normals: Annotated[np.ndarray, Row("float64", "P 3", "1",
        "Outward unit normals there, world.")] = field(default_factory=_NO_POINTS)
    probe_stiffness: Annotated[np.ndarray, Row("float64", "P", "N/m",
        "Force of the cone over its displacement (SBML appendix C.4).")] = field(default_factory=_NO_NUMBERS)
    vsf_points: Annotated[np.ndarray, Row("float64", "n 3", "m",
        "Particles of the oracle VSF, world.")] = field(default_factory=_NO_POINTS)
    vsf_stiffness: Annotated[np.ndarray, Row("float64", "n", "N/m",
        "Spring constant of each particle of the oracle VSF.")] = field(default_factory=_NO_NUMBERS)
    vsf_touched: Annotated[np.ndarray, Row("bool", "n", "1",
        "The particle was displaced by at least one touch of the oracle's fit.")] = field(default_factory=_NO_MARKS)

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
