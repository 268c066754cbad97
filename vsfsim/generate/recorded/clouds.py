"""Point clouds of real depth cameras: their files, and the picture of an object made from one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.errors import DatasetError
from vsfsim.data.records import View

_LARGEST = 640  # pixels along the longer side of a picture
_COARSE = 1.5  # edge of a pixel over the median distance of neighbouring points: wide enough to leave no holes
_MARGIN = 4  # pixels around the object


def lattice(ray: np.ndarray, edge: float) -> tuple[np.ndarray, int, int, np.ndarray]:
    """A picture that holds points with some room, of pixels that are ``edge`` wide at a distance of one metre.

    Args:
        ray: x / z and y / z of the points in the camera's frame (n, 2) [-].

    Returns:
        The same of its first pixel (2,) [-], width and height [px], and the pinhole matrix (3, 3) [px].
    """
    low = ray.min(axis=0) - _MARGIN * edge
    width, height = np.ceil((ray.max(axis=0) - low) / edge).astype(int) + 1 + _MARGIN
    return low, width, height, np.array(
        [[1.0 / edge, 0.0, -low[0] / edge], [0.0, 1.0 / edge, -low[1] / edge], [0.0, 0.0, 1.0]])


def read_pcd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A cloud in the PCD format (version 0.7 of the Point Cloud Library), ``ascii`` or ``binary``.

    Returns:
        Points (n, 3) [m] and their colours (n, 3) uint8 sRGB, mid-grey where the file has none; points that are not
        finite are left out.

    Raises:
        DatasetError: it cannot be read, or is not such a file.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}. It is the point cloud of the object.") from error
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head and at < len(content):
        line, _, _ = content[at:at + 10_000].partition(b"\n")
        at += len(line) + 1
        words = line.decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
    try:
        fields, count = head["FIELDS"], int(head["POINTS"][0])
        types = [f"<{kind.lower()}{size}" for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
        many = [int(number) for number in head.get("COUNT", ["1"] * len(fields))]
        row = np.dtype([(name, kind, (n,)) for name, kind, n in zip(fields, types, many, strict=True)])
        rows = _rows(content[at:], head["DATA"][0], row, count)
        points = np.stack([rows[axis][:, 0] for axis in "xyz"], axis=1).astype(float)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise DatasetError(f"{path} cannot be understood as a PCD file: {error!r}. Write it again "
                           "with x, y and z, DATA ascii or binary.") from error
    packed = next((rows[name][:, 0] for name in ("rgb", "rgba") if name in fields), None)
    if packed is None:
        colours = np.full((count, 3), 128, np.uint8)
    else:
        bits = np.ascontiguousarray(packed, packed.dtype if packed.dtype.kind in "ui" else "<f4").view("<u4")
        colours = np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=1).astype(np.uint8)
    good = np.isfinite(points).all(axis=1)
    return points[good], colours[good]


def _rows(body: bytes, form: str, row: np.dtype, count: int) -> np.ndarray:
    if form == "binary":
        return np.frombuffer(body, row, count)
    if form != "ascii":
        raise ValueError(f"DATA is {form}")
    table = [line.split() for line in body.decode("ascii").splitlines() if line.strip()]
    if len(table) != count:
        raise ValueError(f"{len(table)} rows, and POINTS is {count}")
    out, at = np.zeros(count, row), 0
    for name in row.names or ():
        kind, width = out.dtype[name].base, out[name].shape[1]
        columns = np.array([words[at:at + width] for words in table]).reshape(count, width)
        # a packed colour may be printed as a number of its own
        out[name] = columns.astype(float).astype(kind) if kind.kind in "ui" else columns.astype(kind)
        at += width
    return out


def view_of_cloud(points: np.ndarray, colours: np.ndarray, inside: np.ndarray, eye: np.ndarray) -> View:
    """The picture that a camera at ``eye`` would take of a cloud: in every pixel its nearest point.

    A pixel is as wide as needed for neighbouring points to leave no hole, so that a dense cloud gives a large picture,
    at most 640 pixels along its longer side. A point of `View.points` is off sideways by half a pixel at most.

    Args:
        points: world (n, 3) [m]. colours: theirs (n, 3) uint8. inside: which of them are the object's (n,) bool. eye:
        centre of the camera, world (3,) [m].

    Raises:
        DatasetError: fewer than ten points are the object's, or the camera is among them.
    """
    mine = points[inside]
    if len(mine) < 10:
        raise DatasetError(f"{len(mine)} of {len(points)} points of the cloud lie in the box of "
                           "the object; at least 10 are needed. Correct the box (bbox).")
    forward = mine.mean(axis=0) - eye
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0.0, 0.0, 1.0] if abs(z[2]) < 0.99 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(z, x), z], axis=1)
    local = (points - eye) @ turn
    if local[inside, 2].min() <= 1e-3:
        raise DatasetError(f"the camera at {np.round(eye, 3).tolist()} lies in the object; correct its origin.")
    ray = local[:, :2] / np.maximum(local[:, 2:], 1e-3)
    sample = ray[inside][::max(1, len(mine) // 5000)]
    apart = np.median(cKDTree(ray[inside]).query(sample, k=2)[0][:, 1])
    edge = max(_COARSE * float(apart), float(np.ptp(ray[inside], axis=0).max()) / (_LARGEST - 2 * _MARGIN - 1))
    low, width, height, intrinsics = lattice(ray[inside], edge)
    pixel = np.rint((ray - low) / edge).astype(int)
    seen = np.flatnonzero((local[:, 2] > 1e-3) & (pixel >= 0).all(axis=1) & (pixel < [width, height]).all(axis=1))
    number = pixel[seen, 1] * width + pixel[seen, 0]
    order = np.lexsort((local[seen, 2], number))
    filled, first = np.unique(number[order], return_index=True)
    nearest = seen[order][first]
    rgb, depth = np.zeros((height * width, 3), np.uint8), np.zeros(height * width, np.float32)
    mask = np.zeros(height * width, bool)
    rgb[filled], mask[filled] = colours[nearest], inside[nearest]
    depth[filled] = np.where(inside[nearest], local[nearest, 2], 0.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, eye
    return View(rgb.reshape(height, width, 3), depth.reshape(height, width),
                mask.reshape(height, width), intrinsics, pose)
