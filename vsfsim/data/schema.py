"""The one table of what an object file holds; writer, reader, verifier and the docs page are made from it.

A path is relative to the root of the HDF5 file; ``*`` stands for the three-digit number of a touch. A dimension is a
number, or a letter whose length must agree wherever it occurs within the view, within one touch, or within the truth.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vsfsim.core.errors import DatasetError

FORMAT = "vsfsim-object-view"
SCHEMA_VERSION = 1
CHANNELS = "channels/"
"""What the names of a touch's readings begin with that have no field of their own."""
TEXT = "text"
"""dtype of a row of strings: UTF-8, padded with zero bytes to the longest."""


@dataclass(frozen=True)
class Field:
    """One HDF5 dataset."""

    path: str
    """In the file."""
    dtype: str
    """NumPy name, or `TEXT`."""
    dims: tuple[str, ...]
    """Lengths or letters, outermost first."""
    unit: str
    """Of the stored numbers; "1" is dimensionless."""
    doc: str
    """One sentence."""
    required: bool = True
    """False where the record may hold None."""
    masked: bool = False
    """Along T, only the rows of converged frames must be finite."""

    @classmethod
    def of_channel(cls, name: str, dtype: str, attributes: Mapping[str, object], where: str) -> Field:
        """The row of a channel that another package recorded, from what its file says of it.

        Args:
            name: within a touch, "channels/NAME". dtype: NumPy name. attributes: of the HDF5 dataset. where: file and
            path, for the message.

        Raises:
            DatasetError: it is not described.
        """
        short = name.removeprefix(CHANNELS)
        said = {key: attributes.get(key) for key in ("units", "dims", "doc", "masked")}
        units, dims, doc = said["units"], said["dims"], said["doc"]
        words = dims.split() if isinstance(dims, str) and dims != "scalar" else []
        if not (re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", short) and isinstance(units, str) and isinstance(doc, str)
                and isinstance(dims, str) and dims and said["masked"] in (0, 1)
                and all(re.fullmatch(r"[A-Za-z]|[0-9]{1,9}", word) for word in words)):
            raise DatasetError(f"{where} is not in the schema, and its attributes do not describe it: a channel of "
                               f"another package has units, dims, doc and masked. Install that package, or generate "
                               f"the dataset again with one that gives its channel a row.")
        return cls(f"touches/*/{name}", dtype, tuple(words), units, doc, False, bool(said["masked"]))

    @property
    def attributes(self) -> dict[str, str | bool]:
        """What an HDF5 dataset says of itself; a channel says enough for `of_channel`."""
        own: dict[str, str | bool] = {"doc": self.doc, "masked": self.masked} if self.name.startswith(CHANNELS) else {}
        return {"units": self.unit, "dims": self.dims_text, **own}

    @property
    def group(self) -> str:
        """"view", "touches/*" or "truth"."""
        return "touches/*" if self.path.startswith("touches/") else self.path.split("/")[0]

    @property
    def name(self) -> str:
        """The path within its group: the attribute of the record, ``audit/<column>`` or ``channels/<name>``."""
        return self.path.removeprefix(self.group + "/")

    @property
    def dims_text(self) -> str:
        """What ``@dims`` says: the dimensions with a space between; "scalar" for none."""
        return " ".join(self.dims) or "scalar"


def _view(name: str, dtype: str, dims: str, unit: str, doc: str) -> Field:
    return Field(f"view/{name}", dtype, tuple(dims.split()), unit, doc)


def _touch(name: str, dtype: str, dims: str, unit: str, doc: str, *, required: bool = True,
           masked: bool = False) -> Field:
    return Field(f"touches/*/{name}", dtype, tuple(dims.split()), unit, doc, required, masked)


def _truth(name: str, dtype: str, dims: str, unit: str, doc: str, *, required: bool = True) -> Field:
    return Field(f"truth/{name}", dtype, tuple(dims.split()), unit, doc, required)


FIELDS: list[Field] = [
    _view("rgb", "uint8", "H W 3", "1", "Colour image of the object at rest, sRGB, 0 to 255."),
    _view("depth", "float32", "H W", "m", "Distance along the optical axis; 0 where there is no object."),
    _view("mask", "bool", "H W", "1", "True on the object."),
    _view("intrinsics", "float64", "3 3", "px", "Pinhole matrix; the centre of the top-left pixel is (0, 0)."),
    _view("camera_pose", "float64", "4 4", "m",
          "Camera-to-world transform, OpenCV axes; its rotation part has no unit."),
    _touch("time", "float64", "T", "s", "Time of each frame."),
    _touch("mount_pose", "float64", "T 4 4", "m",
           "Probe-to-world transform, of the probe's mount where a spring carries it; its rotation part has no unit."),
    _touch("axis", "float64", "3", "1", "Unit direction of the press, world."),
    _touch("target", "float64", "3", "m", "The visible point that was aimed at, world."),
    _touch("normal", "float64", "3", "1", "Outward unit normal of the visible cloud at the target, world."),
    _touch("force", "float64", "T 3", "N", "Contact force on the probe, world, free of sensor noise.", masked=True),
    _touch("reaction", "float64", "T 3", "N",
           "Force of the supports on the object, world; equals force where the object weighs nothing.", masked=True),
    _touch("converged", "bool", "T", "1", "The frame is an equilibrium within the solver's tolerance."),
    _touch("residual", "float64", "T", "1", "Relative residual of the equilibrium.", masked=True),
    _touch("iterations", "int64", "T", "1", "Newton iterations spent on the frame."),
    _touch("touched", "bool", "", "1", "The probe met the object in at least one frame."),
    _touch("reason", "int64", "T", "1", "0 for a good frame, else 1 + an index into reason_names."),
    _touch("reason_names", TEXT, "Q", "1", "What the codes of reason mean."),
    _touch("audit/force_balance", "float64", "T", "1",
           "Norm of force - reaction - weight, over the larger norm; 0 in perfect balance. Of plants: over 0.1 "
           "N at least.", masked=True),
    _touch("audit/min_det_f", "float64", "T", "1",
           "Smallest det F of an element; not of a plant, whose beams have none.", masked=True, required=False),
    _touch("audit/energy", "float64", "T", "J", "Elastic energy of the object; with a bubble, of object, skin and air.",
           masked=True),
    _touch("audit/penetration", "float64", "T", "m",
           "Deepest point of the surface inside the probe, between the contact points too; of a bubble, deepest node "
           "of either surface inside the other.", masked=True),
    _touch("audit/contact_points", "int64", "T", "1", "Number of contact points that touch; of a rigid probe.",
           required=False),
    _touch("audit/contact_radius", "float64", "T", "1",
           "How well the contact is resolved: radius of a circle of its area over the edge of the elements there; of a "
           "rigid probe.", required=False),
    _touch("audit/mesh_error", "float64", "T", "1",
           "Estimated error of the force because the contact is small against the elements; of a rigid probe on "
           "tetrahedra.", required=False, masked=True),
    _touch("audit/corner_det_f", "float64", "T", "1",
           "Smallest det F at the corners of the tetrahedra in contact; of a rigid probe on tetrahedra.",
           required=False, masked=True),
    _touch("audit/rotation", "float64", "T", "rad",
           "Largest rotation of a tetrahedron; of a rigid probe on tetrahedra.", required=False, masked=True),
    _touch("audit/finer_force", "float64", "T 3", "N",
           "Force of the same touch on a mesh one level finer, world, 0 where finer_converged is not; of one touch in "
           "ten of a dataset with --accuracy.", required=False),
    _touch("audit/finer_converged", "bool", "T", "1", "The frame is an equilibrium on the finer mesh.",
           required=False),
    _touch("resolved", "bool", "T", "1",
           "The frame is an equilibrium, its mesh_error is 0.1 at most, no corner of an element is inside out, at a "
           "tier of small strain none turns by more than 0.13 rad, and the mesh holds the parts inside; of a rigid "
           "probe on tetrahedra.", required=False),
    _touch("q", "float64", "T 7", "rad", "Joint angles of the arm.", required=False),
    _touch("torque", "float64", "T 7", "N m", "Joint torques due to the contact.", required=False, masked=True),
    _touch("link_force", "float64", "T L 3", "N", "Contact force on each link of the arm, world.", required=False,
           masked=True),
    _touch("link_moment", "float64", "T L 3", "N m",
           "Contact moment on each link about the origin of its frame, world.", required=False, masked=True),
    _touch("draws", "int64", "", "1", "How many targets were drawn until the arm could reach one.", required=False),
    _touch("ended", "int64", "", "1",
           "Why a guarded touch has fewer readings than planned: 0 it has them all, 1 the arm's protective stop on its "
           "way back, 2 the solver's iterations were used up.", required=False),
    _touch("planned_time", "float64", "G", "s", "Time of each frame of the planned touch; kept if [touches] says plan "
           "= true.", required=False),
    _touch("planned_pose", "float64", "G 4 4", "m", "Probe-to-world transform of the plan.", required=False),
    _touch("planned_q", "float64", "G 7", "rad", "Joint angles of the plan.", required=False),
    _touch("planned_frame", "int64", "T", "1",
           "The frame of the plan in which a frame was read; -1 where the arm had left its plan at the force limit.",
           required=False),
    _touch("mount_stiffness", "float64", "", "N/m", "Of the spring along the press that carries the probe.",
           required=False),
    _touch("press", "int64", "", "1", "Kind of the press where the scene has several: 0 its own, k the k-th of its "
           "[[touches.other]].", required=False),
    _touch("pressure", "float64", "T", "Pa", "Gauge pressure of the bubble.", required=False, masked=True),
    _touch("rest_pressure", "float64", "", "Pa", "Gauge pressure of the free dome.", required=False),
    _touch("moment", "float64", "T 3", "N m",
           "Moment of the contact force on the sensor about the mount's origin, world.", required=False, masked=True),
    _touch("node_position", "float32", "T N 3", "m", "Sensor read-out vertices, world.", required=False, masked=True),
    _touch("node_force", "float32", "T N 3", "N", "Contact force on each read-out vertex, world.", required=False,
           masked=True),
    _touch("node_rest", "float64", "N 3", "m", "Read-out vertices of the free dome, mount frame.", required=False),
    _touch("node_reference", "float64", "N 2", "m", "Coordinates of the read-out vertices on the stress-free skin.",
           required=False),
    _touch("node_triangles", "int64", "F 3", "1", "Triangles of the read-out mesh, wound outwards.", required=False),
    _touch("fine_position", "float32", "T V 3", "m",
           "Vertices of the mesh that was solved, world; kept if [sensor] says fine = true.", required=False,
           masked=True),
    _touch("fine_force", "float32", "T V 3", "N", "Contact force on each of them, world.", required=False, masked=True),
    _touch("fine_rest", "float64", "V 3", "m", "The same vertices of the free dome, mount frame.", required=False),
    _touch("fine_triangles", "int64", "K 3", "1", "Triangles of that mesh, wound outwards.", required=False),
    _touch("inside_depth", "float32", "T h w", "m",
           "What the camera in the bubble sees: distance along its axis; 0 where there is no skin.", required=False,
           masked=True),
    _touch("inside_rgb", "uint8", "T h w 3", "1", "Colour image of the same, sRGB, 0 to 255.", required=False),
    _truth("points", "float64", "M 3", "m", "Centroid of each element at rest, world."),
    _truth("young_modulus", "float64", "M", "Pa", "Young's modulus at each centroid."),
    _truth("radius", "float64", "M", "m", "Of a plant's segment; half the thickness of a leaf blade.", required=False),
    _truth("half_width", "float64", "M", "m", "Of a leaf blade's segment, 0 for a round one.", required=False),
    _truth("segment_ends", "float64", "M 2 3", "m", "Ends of a plant's segments on its middle line, world.",
           required=False),
    _truth("region", "int64", "M", "1", "Region of each element, an index into region_names."),
    _truth("region_names", TEXT, "R", "1", "Names of the object's parts."),
    _truth("notes", TEXT, "S", "1", "What the object is, and why others were drawn before it, one sentence each.",
           required=False),
    _truth("probe_points", "float64", "P 3", "m", "Surface points where the small cone was pressed, world."),
    _truth("probe_normals", "float64", "P 3", "1", "Outward unit normals there, world."),
    _truth("probe_stiffness", "float64", "P", "N/m", "Force of the cone over its displacement (SBML appendix C.4)."),
    _truth("vsf_points", "float64", "n 3", "m", "Particles of the oracle VSF, world."),
    _truth("vsf_stiffness", "float64", "n", "N/m", "Spring constant of each particle of the oracle VSF."),
    _truth("vsf_touched", "bool", "n", "1", "The particle was displaced by at least one touch of the oracle's fit."),
]
"""The table. A sensor that is not part of this package appends its rows, ``touches/*/channels/NAME``, when it is
imported; a file describes them, so that it is read without that package (`Field.of_channel`)."""

ATTRIBUTES: Mapping[str, tuple[str, str]] = {
    "format": ("text", f"always {FORMAT!r}"),
    "schema_version": ("integer", f"{SCHEMA_VERSION} in this version of vsfsim"),
    "name": ("text", "name of the object view, unique in its dataset"),
    "object_index": ("integer", "of the object, from 0"),
    "view_index": ("integer", "of the view of that object, from 0"),
    "split": ("text", "train, test, ... as the scene names them"),
    "probe": ("text", 'JSON table of the shape that touched it, in metres, e.g. {"sphere": 0.02}; {"chain": ..} of an '
                      'arm, {"dome": ..} of a bubble: its free skin; a list where the scene has presses of several '
                      'kinds'),
}
"""Attributes of the root of an object file: type and meaning."""


MANIFEST_KEYS: Mapping[str, str] = {
    "digest": "sha256 of all the other keys, so that no byte can change unseen",
    "format": "always 'vsfsim-dataset'",
    "schema_version": f"{SCHEMA_VERSION} in this version of vsfsim",
    "made_by": "version and commit of vsfsim",
    "sha256": "identity of the content: over name, split and sha256 of every object file, in order",
    "recipe": "what the files were made from: scene and its text, seed, counts, splits, device, tier, "
              "precision, renderer",
    "left_out": "only where object views could not be made: their names, each with the reason",
    "accuracy": "only with --accuracy: error of the force asked for, tier and element size chosen for it (or a list "
                "of them, one a class of objects), the error expected, and that of the audited touches",
    "files": "one entry a file: name, split, indices, counts, bytes, sha256, and the kind of CPU or GPU that made it",
}
"""Keys of dataset.json and their meaning."""


def fields_of(group: str) -> tuple[Field, ...]:
    """The rows of one group: "view", "touches/*" or "truth"."""
    return tuple(field for field in FIELDS if field.group == group)


def check_array(field: Field, array: np.ndarray, where: str, lengths: dict[str, int]) -> np.ndarray:
    """``array`` as the schema wants it, or a refusal.

    Args:
        field: the row of the table.
        array: what is to be stored, or was read.
        where: file and path, for the message.
        lengths: length of each letter seen so far in this group; new letters are added.

    Raises:
        DatasetError: wrong number of dimensions, a length that disagrees, or a dtype that would lose information.
    """
    if field.dtype == TEXT:
        array = np.asarray(array, dtype=object).reshape(-1) if np.size(array) == 0 else np.asarray(array, dtype=object)
    else:
        array = np.asarray(array)
        if not np.can_cast(array.dtype, field.dtype, "same_kind"):
            raise DatasetError(f"{where} has dtype {array.dtype}; the schema wants {field.dtype}. Convert it before "
                               f"it is stored.")
        array = array.astype(field.dtype, copy=False)
    check_shape(field, array.shape, where, lengths)
    return array


def check_shape(field: Field, shape: tuple[int, ...], where: str, lengths: dict[str, int]) -> None:
    """Refuse a shape that the schema does not allow, before the array is read; operands as of `check_array`.

    Raises:
        DatasetError: wrong number of dimensions, or a length that disagrees.
    """
    if len(shape) != len(field.dims):
        raise DatasetError(f"{where} has shape {shape}; the schema wants ({', '.join(field.dims)}).")
    for dim, length in zip(field.dims, shape):
        want = int(dim) if dim.isdigit() else lengths.setdefault(dim, length)
        if length != want:
            raise DatasetError(f"{where} has shape {shape}; the schema wants ({', '.join(field.dims)}) with "
                               f"{dim} = {want} here.")


def first_bad(field: Field, array: np.ndarray, converged: np.ndarray | None, *,
              recorded: bool = False) -> tuple[int, ...] | None:
    """Index of the first number that must be finite and is not, or None.

    Args:
        field: the row of the table; ``masked`` rows may be NaN in frames that did not converge.
        array: its values.
        converged: (T,) bool of the touch; None outside touches.
        recorded: whether a real sensor made it, which reads some of the masked fields and leaves others NaN throughout.
    """
    if array.dtype.kind != "f":
        return None
    bad = ~np.isfinite(array)
    if field.masked and converged is not None:
        if recorded and np.isnan(array).all():
            return None
        bad[~np.asarray(converged, bool)] = False
    where = np.argwhere(bad)
    return tuple(int(i) for i in where[0]) if len(where) else None


def schema_markdown() -> str:
    """The docs page of a dataset: the folder and the object file."""
    lines = [
        "# The dataset", "",
        "A folder with `dataset.json` and one HDF5 file per object view. While it is being made there is a "
        "`dataset.part.json` and a",
        "`dataset.lock` instead of `dataset.json`; `vsfsim generate` goes on from there. `vsfsim verify` checks "
        "everything on this page.", "",
        "| key of dataset.json | meaning |", "|---|---|",
        *(f"| `{key}` | {doc} |" for key, doc in MANIFEST_KEYS.items()), "",
        "## The object file", "",
        f"Schema version {SCHEMA_VERSION}. Every HDF5 dataset carries `@units` and `@dims`. A file holds its data "
        "itself: links, data in other files, filters other than gzip and shuffle, and fields of more than 512 MiB are "
        "refused before they are read, and so are entries of dataset.json that are there twice or whose names are "
        "paths.",
        "`touches/*` stands for `touches/000`, `touches/001`, ... in the order they were made. Letters are "
        "lengths: H, W of",
        "the image; T frames of a touch; N read-out vertices, F their triangles; V vertices of the solved mesh, K its "
        "triangles; h, w of the inside image; L links of the arm; Q reasons; M elements, R regions, P probed "
        "points and n",
        "particles of the truth. Rows marked *masked* may be NaN in frames whose `converged` is False, and "
        "nowhere else; in a recording of a real object (M = 0: nothing of its truth is known) those that no sensor "
        "read are NaN throughout.", "",
        "A frame whose `resolved` is False and whose `converged` is True is an equilibrium of the mesh, with a "
        "force that",
        "the mesh makes wrong by more than an estimated tenth, or with parts inside that it does not hold. It keeps "
        "its",
        "numbers, and `valid` of a reading that a method gets is True for it: `valid` says that there is a number. A "
        "light",
        "first contact is often such a frame, and its force is small. Leave such frames out where a tenth matters;",
        "`touch.resolved` is None in data that do not measure it.", "",
        "A sensor of another package records `touches/*/channels/NAME`. Such a dataset has the attributes `doc` (one "
        "sentence)",
        "and `masked` besides `units` and `dims`; with them it is read and verified where that package is not "
        "installed.", "",
        "| root attribute | type | meaning |", "|---|---|---|",
    ]
    lines += [f"| `{name}` | {kind} | {doc} |" for name, (kind, doc) in ATTRIBUTES.items()]
    for group, title in (("view", "View"), ("touches/*", "Touches"),
                         ("truth", "Truth (the last group; a blind dataset never reads it)")):
        lines += ["", f"### {title}", "", "| path | dtype | dims | unit | | meaning |", "|---|---|---|---|---|---|"]
        for field in fields_of(group):
            marks = ", ".join(m for m, on in (("optional", not field.required), ("*masked*", field.masked)) if on)
            lines.append(f"| `{field.path}` | {field.dtype} | {field.dims_text} | {field.unit} | {marks} | "
                         f"{field.doc} |")
    return "\n".join(lines) + "\n"
