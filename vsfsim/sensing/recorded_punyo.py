"""Recorded sequences of a Punyo, as touches from which `vsfsim.sensing.bubble_touch.estimate_forces` estimates forces.

    FOLDER/pc_K.npy         (H * W, 3) or (H, W, 3)  cloud of frame K, a point a pixel, camera's frame [m]; z = 0: none
           rgb_K.npy        (H, W, 3) uint8          picture by the same pixels
           pressure_K.npy   ()                       absolute or gauge [hPa]

Nodes of the free dome are followed from a reference frame by the patterns on the skin (`vsfsim.sensing.track`); the
cloud at a node's pixel, now and then, gives its displacement. Nodes that the camera does not see, or loses, take the
displacement that is smoothest over the mesh, with the rim at rest; `Sequence.seen` says which. Source of the layout:
github uiuc-iml/punyo_force_estimation (demo/explode_data.py).
"""

from __future__ import annotations

from collections.abc import Sequence as Frames
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from vsfsim.data.records import Touch
from vsfsim.sensing.bubble_touch import rim_of
from vsfsim.sensing.membrane_fe import SensorError, checked_mesh
from vsfsim.sensing.track import track

LIKENESS = 0.8
"""Correlation of its patch from which a node counts as followed."""
REACH = 0.03
"""A followed node that moves farther is taken for lost [m]; the dome is 30.5 mm high."""
_NEAR = 2  # pixels around a node whose points of the cloud are averaged
_HPA = 100.0


@dataclass(frozen=True)
class Sequence:
    """What was read."""

    touch: Touch
    """In the camera's frame, which is both the mount's and the world's; contact forces are unknown, NaN."""
    frames: tuple[int, ...]
    """Number K of each frame."""
    seen: np.ndarray
    """Whether a node was followed by the camera (T, N) bool; the others are interpolated."""


def read_sequence(folder: str | Path, vertices: np.ndarray, triangles: np.ndarray, *, rest_pressure: float,
                  frames: Frames[int] | None = None, reference: Frames[int] = range(5),
                  flat: np.ndarray | None = None, pre_stretch: float = 1.1) -> Sequence:
    """Read a sequence.

    Args:
        folder: of the files.
        vertices: of the free dome in the camera's frame (N, 3) [m].
        triangles: of the dome without its base (M, 3), wound outwards.
        rest_pressure: gauge pressure of the free dome [Pa]; absolute readings are shifted so that the reference frames
            have it.
        frames: numbers of the frames; default: all but the reference's.
        reference: numbers of frames without contact, whose pressures and clouds are averaged.
        flat: coordinates of the vertices on the flat sheet before it was blown up (N, 2) [m], which method `membrane`
            needs; None if unknown.
        pre_stretch: of the sheet in its clamp [-].

    Raises:
        SensorError: a file is missing or has another shape, or the camera sees too little of the dome.
    """
    folder = Path(folder)
    rest, faces = checked_mesh(vertices, triangles, "recorded Punyo")
    numbers = sorted(int(p.stem.removeprefix("pressure_")) for p in folder.glob("pressure_*.npy")
                     if p.stem.removeprefix("pressure_").isdigit())
    chosen = tuple(n for n in numbers if n not in set(reference)) if frames is None else tuple(frames)
    if not chosen or not len(reference):
        raise SensorError(f"recorded Punyo: {folder} has {len(numbers)} frames (pressure_K.npy), and none is left "
                          f"beside the reference frames {list(reference)}.")
    first, cloud, _ = _frame(folder, reference[0])
    camera = _intrinsics(cloud, folder)
    pixels = rest[:, :2] / rest[:, 2:] * camera[0] + camera[1]
    still = [_frame(folder, k) for k in reference]
    at_rest = np.mean([_at(c, pixels) for _, c, _ in still], axis=0)  # NaN where one of them has no point
    tare = float(np.mean([p for _, _, p in still]))
    rim = rim_of(faces, len(rest))
    smooth = _Smooth(rest, faces, rim)
    position = np.empty((len(chosen), *rest.shape))
    seen, pressure = np.zeros((len(chosen), len(rest)), bool), np.empty(len(chosen))
    for t, k in enumerate(chosen):
        picture, cloud, read = _frame(folder, k)
        moved_to, likeness = track(first, picture, pixels)
        shift = _at(cloud, moved_to) - at_rest
        good = (likeness > LIKENESS) & np.isfinite(shift).all(axis=1) & ~rim
        good[good] = np.linalg.norm(shift[good], axis=1) < REACH
        if good.sum() < 0.3 * (~rim).sum():
            raise SensorError(f"recorded Punyo: in frame {k} of {folder} the camera follows {int(good.sum())} of "
                              f"{int((~rim).sum())} nodes inside the rim. Check that the vertices are those of the "
                              f"free dome in the camera's frame, in metres.")
        position[t], seen[t], pressure[t] = rest + smooth.fill(shift, good), good, rest_pressure + read - tare
    count = len(chosen)
    unread, pose = np.full(count, np.nan), np.tile(np.eye(4), (count, 1, 1))
    axis = np.average(np.cross(*(rest[faces[:, k]] - rest[faces[:, 0]] for k in (1, 2))), axis=0)
    axis /= np.linalg.norm(axis)
    deepest = int(np.argmax(pressure))
    place = int(np.argmax(np.linalg.norm(position[deepest] - rest, axis=1)))
    reference_flat = None if flat is None else np.asarray(flat, float) / pre_stretch
    touch = Touch(time=np.array(chosen, float), mount_pose=pose, axis=axis, target=position[deepest, place],
                  normal=-axis, force=np.full((count, 3), np.nan), reaction=np.full((count, 3), np.nan),
                  converged=np.ones(count, bool), residual=unread, iterations=np.zeros(count, np.int64),
                  touched=bool(np.abs(pressure - rest_pressure).max() > 50.0), reason=np.zeros(count, np.int64),
                  pressure=pressure, rest_pressure=float(rest_pressure), node_position=position, node_rest=rest,
                  node_reference=reference_flat, node_triangles=faces)
    return Sequence(touch, chosen, seen)


def _frame(folder: Path, k: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Grey picture (H, W), cloud (H, W, 3) [m] with NaN where there is none, and pressure [Pa] of a frame."""
    found = []
    for name in ("rgb", "pc", "pressure"):
        path = folder / f"{name}_{k}.npy"
        try:
            found.append(np.load(path, allow_pickle=False))
        except (OSError, ValueError, EOFError) as error:
            raise SensorError(f"recorded Punyo: {path} cannot be read: {error}.") from error
    picture, cloud, pressure = found
    if picture.ndim != 3 or picture.shape[2] != 3 or cloud.size != picture.size or np.size(pressure) != 1:
        raise SensorError(f"recorded Punyo: frame {k} of {folder} has a picture {picture.shape}, a cloud "
                          f"{cloud.shape} and a pressure {np.shape(pressure)}; (H, W, 3), as many points as "
                          f"pixels and one number are needed.")
    cloud = cloud.reshape(picture.shape).astype(float)
    cloud[~(cloud[..., 2] > 0.0)] = np.nan
    return picture.astype(float).mean(axis=2), cloud, float(np.reshape(pressure, -1)[0]) * _HPA


def _intrinsics(cloud: np.ndarray, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Focal lengths and centre (2,) [px] of the pinhole camera whose pixels see the points of a cloud (H, W, 3)."""
    row, column = np.nonzero(np.isfinite(cloud[..., 2]))
    if len(row) < 100:
        raise SensorError(f"recorded Punyo: the first reference frame of {folder} has {len(row)} points; a depth image "
                          f"is needed.")
    ray = cloud[row, column, :2] / cloud[row, column, 2:]
    lines = [np.polyfit(ray[:, i], pixel, 1) for i, pixel in enumerate((column, row))]
    off = max(float(np.percentile(np.abs(np.polyval(line, ray[:, i]) - pixel), 95)) for i, (line, pixel)
              in enumerate(zip(lines, (column, row), strict=True)))
    if off > 2.0:
        raise SensorError(f"recorded Punyo: the clouds of {folder} are none of a pinhole camera, pixel by pixel: one "
                          f"point in twenty is {off:.1f} pixels off and more.")
    return np.array([line[0] for line in lines]), np.array([line[1] for line in lines])


def _at(cloud: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The cloud (H, W, 3) at places (n, 2) of the picture, column and row: a plane through the points around each, at
    the place; NaN where fewer than half of the pixels have a point."""
    height, width = cloud.shape[:2]
    steps = np.arange(-_NEAR, _NEAR + 1)
    near = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    centre = np.rint(np.nan_to_num(pixels[:, ::-1], nan=-1e6)).astype(int)
    at = centre[:, None] + near
    inside = ((at >= 0) & (at < [height, width])).all(axis=2)
    at = np.clip(at, 0, [height - 1, width - 1])
    points = np.where(inside[..., None], cloud[at[..., 0], at[..., 1]], np.nan)
    out = np.full((len(pixels), 3), np.nan)
    for n in np.flatnonzero(np.isfinite(points[..., 2]).sum(axis=1) > len(near) // 2):
        good = np.isfinite(points[n, :, 2])
        design = np.column_stack([np.ones(good.sum()), at[n, good][:, ::-1] - pixels[n]])
        out[n] = np.linalg.lstsq(design, points[n, good], rcond=None)[0][0]
    return out


class _Smooth:
    """Displacements over a mesh of which some nodes are known: those of least squared differences along edges."""

    def __init__(self, rest: np.ndarray, faces: np.ndarray, rim: np.ndarray):
        edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        weight = 1.0 / np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1) ** 2
        a = sparse.coo_matrix((weight, tuple(edges.T)), shape=(len(rest),) * 2)
        a = a + a.T
        self._laplace = (sparse.diags(np.asarray(a.sum(axis=1)).ravel()) - a).tocsr()
        self._rim = rim

    def fill(self, shift: np.ndarray, good: np.ndarray) -> np.ndarray:
        """``shift`` (N, 3) at the ``good`` nodes (N,), 0 on the rim, and smooth between them."""
        out = np.where(good[:, None], shift, 0.0)
        free = np.flatnonzero(~good & ~self._rim)
        if len(free):
            known = np.flatnonzero(good | self._rim)
            matrix = self._laplace[free]
            out[free] = spsolve(matrix[:, free].tocsc(), -matrix[:, known] @ out[known]).reshape(-1, 3)
        return out
