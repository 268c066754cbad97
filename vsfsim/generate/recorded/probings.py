"""Recorded presses of a ball on real objects, as a dataset without truth: one file an object.

    FOLDER/OBJECT.csv   a row a frame [m, N]: press, x, y, z of the ball's centre, fx, fy, fz on the ball, the outward
                        normal nx, ny, nz of the surface, radius of the ball, and, if presses failed, failed (0 or 1)
    FOLDER/OBJECT.npz   position and force (n, T, 3), normal (n, 3), radius (), and if known failed (n,) and contact
                        (n, 3), the surface point that was met [m, N]
    FOLDER/OBJECT.mat   RESULTS, an array of MATLAB's ProbingData in mm and N, as github
                        vu-arma-dev/robot-palpation-data has them (ProbingData.m)

Nobody took a picture: it is made of the contact points, seen from above (+z). A contact that no file gives lies under
the centre in the first frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from vsfsim.core.errors import DatasetError
from vsfsim.core.extras import require
from vsfsim.core.shape import Sphere
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, View
from vsfsim.generate.recorded.clouds import lattice
from vsfsim.generate.recorded.written import SPLIT, nothing_known, recorded_touch, write_recorded

SHALLOW, STRONG = 0.0005, 20.0
"""Presses less deep [m], and those with more force [N], are left out: the ball may have missed, or hit what is hard."""
SAME = 0.0005
"""Presses of two days whose contacts lie so near are of one place [m]."""
_FINE, _HEIGHT = 0.0002, 0.3  # edge of a pixel that holds one contact; of the camera [m]
_LEAST = 10  # presses of an object
_RADII = 0.0005, 0.05  # of a ball [m]


@dataclass(frozen=True)
class Options:
    """How a folder is read."""

    pitch: float = 0.0007
    """Edge of a pixel of the picture, whose surface is interpolated between the contact points [m]; 0: these alone."""
    contact_offset: float = 0.0
    """How far the surface lies above the recorded contacts, where contact was noticed late [m]."""
    touches: int | None = None
    """Of each object, drawn from its presses; None for all."""
    again: tuple[str, ...] = ()
    """Recordings of places that another one touched too; they become no objects."""


@dataclass(frozen=True)
class Press:
    """One press of T frames; `depth` is from the first one."""

    position: np.ndarray  # of the ball's centre (T, 3) [m]
    force: np.ndarray  # on the ball (T, 3) [N]
    normal: np.ndarray  # of the surface, outward (3,) [-]
    contact: np.ndarray  # (3,) [m]
    failed: bool = False

    @property
    def depth(self) -> np.ndarray:
        """Of each frame (T,) [m]."""
        return (self.position[0] - self.position) @ self.normal

    @property
    def normal_force(self) -> np.ndarray:
        """Of each frame (T,) [N]."""
        return self.force @ self.normal

    def fault(self) -> str:
        """Why it is left out, "" for a good one."""
        if self.failed or not all(np.isfinite(a).all() for a in (self.position, self.force, self.normal, self.contact)):
            return "failed"
        if self.depth.max() < SHALLOW:
            return f"less than {1e3 * SHALLOW:g} mm deep"
        return f"over {STRONG:g} N" if np.linalg.norm(self.force, axis=1).max() > STRONG else ""


def import_probings(folder: Path, out: Path, options: Options = Options()) -> Dataset:
    """Write a dataset of recorded presses. ``recipe.options`` of it says what was left out, and how well a second
    recording of the same places repeats the first.

    Args:
        folder: with one file an object. out: the new folder, which appears whole or not at all. options: how it is
        read.

    Raises:
        DatasetError: no file, one that cannot be read, too few presses, or the new folder exists.
        MissingPackage: a .mat file, and mat-io is not installed.
    """
    files = sorted((path for path in folder.glob("*") if path.suffix in READERS), key=lambda path: path.stem)
    if not files or not set(options.again) <= {path.stem for path in files}:
        raise DatasetError(f"{folder} holds {', '.join(p.stem for p in files) or 'no file'} ({', '.join(READERS)}). It "
                           f"must hold a file for each object{''.join(f', and {name}' for name in options.again)}.")
    usable, radii, faults = dict[str, list[Press]](), dict[str, float](), dict[str, dict[str, int]]()
    for path in files:
        presses, radii[path.stem] = _read(path)
        told = [press.fault() for press in presses]
        usable[path.stem] = [press for press, fault in zip(presses, told) if not fault]
        faults[path.stem] = dict(Counter(filter(None, told)))
        fewest = max(_LEAST, options.touches or 0)
        if len(usable[path.stem]) < fewest:
            raise DatasetError(f"{path} has {len(usable[path.stem])} usable presses of {len(presses)} "
                               f"({faults[path.stem]}); {fewest} are needed. Leave it out, or ask for fewer touches.")
    names = [name for name in usable if name not in options.again]
    views = [_view(number, name, usable[name], radii[name], options) for number, name in enumerate(names)]
    repeats = {name: max(repeatability(usable[name], usable[other]) + (other,) for other in names)
               for name in options.again}
    return write_recorded(folder, out, views, "recorded: presses of a ball", {
        "pitch": options.pitch, "contact_offset": options.contact_offset, "left_out": faults,
        "again": {name: {"of": other, "places": places, "rmse_ratio": float(f"{ratio:.4f}")}
                  for name, (places, ratio, other) in repeats.items()}})


def repeatability(presses: list[Press], others: list[Press]) -> tuple[int, float]:
    """How well presses of another day foretell the normal forces of some: the number of places that both touched
    (`SAME`), and the rmse of the force at the same depth over that of predicting zero [-]; NaN without such places."""
    away, nearest = cKDTree([press.contact for press in others]).query([press.contact for press in presses])
    error, size, places = 0.0, 0.0, 0
    for press, other in ((p, others[k]) for p, k, d in zip(presses, nearest, away) if d < SAME):
        order = np.argsort(other.depth, kind="stable")
        known = press.depth <= other.depth.max()
        force = press.normal_force[known]
        off = np.interp(press.depth[known], other.depth[order], other.normal_force[order]) - force
        error, size, places = error + float(off @ off), size + float(force @ force), places + 1
    return places, float(np.sqrt(error / size)) if size else float("nan")


def _view(number: int, name: str, presses: list[Press], radius: float, options: Options) -> ObjectView:
    drawn = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(number,))).permutation(len(presses))
    surface = np.array([press.contact + options.contact_offset * press.normal for press in presses])
    touches = []
    for k in sorted(drawn[:options.touches]):
        press = presses[k]
        pose = np.tile(np.eye(4), (len(press.position), 1, 1))
        pose[:, :3, 3] = press.position
        touches.append(recorded_touch(time=np.arange(float(len(pose))), mount_pose=pose, axis=-press.normal,
                                      target=surface[k], normal=press.normal, force=press.force, touched=True))
    return ObjectView(name, number, 0, SPLIT, Sphere(radius), view_from_above(surface, options.pitch), tuple(touches),
                      nothing_known(f"{name} is a real object, pressed by a ball at {len(presses)} places"))


def view_from_above(points: np.ndarray, pitch: float) -> View:
    """The picture of a surface through points (n, 3) [m], linear between them, with pixels of about ``pitch`` [m]; for
    a pitch of 0 of the points alone, in pixels of 0.2 mm. There is no object outside the points' convex hull."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = np.array([*points[:, :2].mean(axis=0), points[:, 2].max() + _HEIGHT]).round(6)
    local = (points - pose[:3, 3]) * [1.0, -1.0, -1.0]
    ray, edge = local[:, :2] / local[:, 2:], round((pitch or _FINE) / float(local[:, 2].mean()), 9)
    low, width, height, camera = lattice(ray, edge)
    if pitch:  # along a plane 1 / depth is linear in the picture
        at = low + edge * np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=2)
        depth = np.nan_to_num(1.0 / LinearNDInterpolator(ray, 1.0 / local[:, 2])(at))
    else:
        depth = np.zeros((height, width))
        depth[tuple(np.rint((ray - low) / edge).astype(int).T[::-1])] = local[:, 2]
    return View(np.where(depth > 0.0, 128, 0)[..., None].repeat(3, axis=2).astype(np.uint8),
                depth.round(7).astype(np.float32), depth > 0.0, camera, pose)


# ---------------------------------------------------------------------- files

def _read(path: Path) -> tuple[list[Press], float]:
    try:
        presses, radius = READERS[path.suffix](path)
        if any(p.position.shape != (len(p.position), 3) or p.force.shape != p.position.shape
               or not p.normal.shape == p.contact.shape == (3,) for p in presses if not p.failed):
            raise ValueError("positions and forces must have the shape (T, 3), normals and contacts (3,)")
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, EOFError) as error:
        raise DatasetError(f"{path} cannot be read as presses of a ball: {error!r}. docs/howto.md (Presses of a "
                           f"ball) says what such a file holds.") from error
    if not _RADII[0] <= radius <= _RADII[1]:
        raise DatasetError(f"{path}: the ball's radius is {radius:g} m; {_RADII[0]:g} to {_RADII[1]:g} m are allowed. "
                           f"Give lengths in metres.")
    return presses, radius


def _press(position: np.ndarray, force: np.ndarray, normal: np.ndarray, radius: float, failed: Any = False,
           contact: np.ndarray | None = None) -> Press:
    unit = (normal / max(float(np.linalg.norm(normal)), 1e-9)).round(9)  # to the same bits by every machine
    return Press(position, force, unit, position[0] - radius * unit if contact is None else contact, bool(failed))


def _csv(path: Path) -> tuple[list[Press], float]:
    if not path.stat().st_size:  # of which NumPy warns, too
        raise ValueError("the file is empty")
    table = np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, dtype=float))
    columns = {name: np.stack([table[f"{name}{axis}"] for axis in "xyz"], axis=1) for name in ("", "f", "n")}
    failed = table["failed"] if "failed" in (table.dtype.names or ()) else np.zeros(len(table))
    radius, rows = float(table["radius"][0]), [np.flatnonzero(table["press"] == k) for k in np.unique(table["press"])]
    return [_press(columns[""][r], columns["f"][r], columns["n"][r[0]], radius, failed[r].any()) for r in rows], radius


def _npz(path: Path) -> tuple[list[Press], float]:
    with np.load(path, allow_pickle=False) as file:
        table = {name: np.asarray(file[name], float) for name in file.files}
    count, radius = len(table["position"]), float(table["radius"])
    failed, contact = table.get("failed", np.zeros(count)), table.get("contact", [None] * count)
    return [_press(*row[:3], radius, *row[3:]) for row in zip(
        table["position"], table["force"], table["normal"], failed, contact, strict=True)], radius


def _mat(path: Path) -> tuple[list[Press], float]:
    require("recorded", "matio")
    from matio import load_from_mat

    presses, radii, none = [], [], np.zeros(0)
    for found in np.ravel(load_from_mat(path)["RESULTS"]):
        if not hasattr(found, "properties"):  # a place that was planned and never pressed
            presses.append(Press(none, none, none, none, failed=True))
            continue
        of = found.properties
        contact, centre = (np.ravel(of[name]) / 1e3 for name in ("ContactPoint", "ContactBallCenter"))
        radii.append(np.linalg.norm(contact - centre))
        made = np.any(of["CurrentPos"] != 0.0, axis=1)  # a press that was stopped leaves its last rows at 0
        presses.append(_press(of["CurrentPos"][made] / 1e3, np.asarray(of["DeformedForce"], float)[made],
                              np.ravel(of["ContactSurfNorm"]), 0.0, np.any(of["Fail"]), contact))
    return presses, float(f"{np.median(radii):.5f}")


READERS: dict[str, Callable[[Path], tuple[list[Press], float]]] = {".csv": _csv, ".mat": _mat, ".npz": _npz}
