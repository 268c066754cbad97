"""Pictures of depth by other renderers, of the surfaces of our scenes: `vsfsim measure render`.

Each peer is a function of `drawing.py`, run by a Python of its own: a venv is made in the folder that is given, and
filled from the package registry. Errors are against rays that are cast in double precision, triangle by triangle.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from measurements.indent import Skipped, python_of
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.streams import Stream, stream
from vsfsim.generate.effector import effector_of
from vsfsim.sensing.camera import look_at, render
from vsfsim.sensing.surface import Surface

SCENES = ("shoes-v3-mini", "plants-mini")
"""A closed surface of a few thousand triangles, and thin leaves and branches."""
PEERS = {"trimesh": ("trimesh", "embreex", "scipy", "rtree"), "open3d": ("open3d",), "pyrender": ("pyrender",),
         "mujoco": ("mujoco",)}
"""Requirements by peer."""
PICTURES = 5
LIMIT = 600.0
"""A peer that takes longer for one scene is left out [s]."""


def exact(points: np.ndarray, triangles: np.ndarray, focal: float, size: tuple[int, int]) -> np.ndarray:
    """z (height, width) [m] of the nearest triangle along the ray of each pixel, infinite where there is none.

    Args:
        points: in front of a camera with OpenCV axes at the origin (n, 3) [m].
        triangles: (m, 3).
        focal: [px]; the optical axis meets the middle of the picture.
        size: width and height [px].
    """
    width, height = size
    middle = 0.5 * np.array([width - 1, height - 1])
    out = np.full((height, width), np.inf)
    corners = points[triangles]
    at = focal * corners[..., :2] / corners[..., 2:] + middle
    first = np.maximum(np.ceil(at.min(axis=1) - 1e-9), 0).astype(int)
    last = np.minimum(np.floor(at.max(axis=1) + 1e-9), [width - 1, height - 1]).astype(int)
    for k in np.flatnonzero((first <= last).all(axis=1)).tolist():
        column, row = np.meshgrid(np.arange(first[k, 0], last[k, 0] + 1), np.arange(first[k, 1], last[k, 1] + 1))
        ray = np.stack([(column - middle[0]) / focal, (row - middle[1]) / focal, np.ones(column.shape)], axis=-1)
        if abs(np.linalg.det(corners[k])) < 1e-300:
            continue  # seen from its edge
        share = ray @ np.linalg.inv(corners[k])  # of the corners, times 1 / z
        hit = (share >= 0.0).all(axis=-1)
        part = out[first[k, 1]:last[k, 1] + 1, first[k, 0]:last[k, 0] + 1]
        part[hit] = np.minimum(part[hit], 1.0 / share[hit].sum(axis=-1))
    return out


def compared(depth: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Share of the pixels on the object that one of two pictures does not have [-], and of the others the root mean
    square, the median and the largest difference [m], which are NaN where there are no others."""
    seen, there = depth > 0.0, np.isfinite(truth)
    off = np.abs(depth - truth)[seen & there]
    if not len(off):
        return {"missed": 1.0, "rms": np.nan, "median": np.nan, "worst": np.nan}
    return {"missed": float((seen != there).sum() / there.sum()), "rms": float(np.sqrt(np.mean(off**2))),
            "median": float(np.median(off)), "worst": float(off.max())}


def drawn(peer: str, case: Path, folder: Path) -> dict[str, Any]:
    """The picture of a peer.

    Raises:
        Skipped: it cannot run, with the last line that it printed.
    """
    out = case.with_name(f"{case.stem}-{peer}.npz")
    python = python_of(peer, folder, PEERS[peer])
    try:
        found = subprocess.run([str(python), str(Path(__file__).parent / "drawing.py"), peer, str(case), str(out)],
                               capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        raise Skipped(f"it took longer than {LIMIT:g} s") from None
    if found.returncode:
        raise Skipped(f"its script ended with {(found.stderr.strip().splitlines() or ['no word'])[-1]}")
    return {name: value[()] if value.ndim == 0 else value for name, value in np.load(out).items()}


def ours(surface: Surface, intrinsics: np.ndarray, pose: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Our picture of z and the CPU time of one [s]."""
    render(surface, intrinsics, pose, *size)  # kernels
    began = time.process_time()
    for _ in range(PICTURES):
        view = render(surface, intrinsics, pose, *size)
    return view.depth.astype(float), (time.process_time() - began) / PICTURES


def measure(scenes: Sequence[str] = (), peers: Sequence[str] = (), *, folder: Path = Path("renderers"),
            progress: Progress = lambda said: None) -> Measurement:
    """The table.

    Args:
        scenes: names or paths; empty for `SCENES`.
        peers: keys of `PEERS`; empty for all.
        folder: of the venvs.
        progress: called with what is going on.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    settings: dict[str, str] = {}
    for name in scenes or SCENES:
        loaded = load_scene(find_scene(name))
        scene = loaded.sample(stream(0, Stream.SCENE, 0), number=0)
        surface = effector_of(scene).draw(scene, stream(0, Stream.BODY, 0)).surface
        size = (scene.camera.width, scene.camera.height)
        intrinsics, pose = look_at(scene.camera, 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)))
        points, focal = (surface.vertices - pose[:3, 3]) @ pose[:3, :3], float(intrinsics[0, 0])
        case = folder.absolute() / f"{loaded.path.stem}.npz"
        np.savez(case, points=points, triangles=surface.triangles, size=size, focal=focal)
        truth = exact(points, surface.triangles, focal, size)
        what = {"scene": name, "triangles": len(surface.triangles), "pixels": f"{size[0]} x {size[1]}"}
        progress(f"{name}: ours")
        depth, seconds = ours(surface, intrinsics, pose, size)
        rows.append({**what, "peer": "vsfsim", **compared(depth, truth), "seconds": seconds, "said": "with colours"})
        for peer in peers or PEERS:
            progress(f"{name}: {peer}")
            try:
                made = drawn(peer, case, folder)
            except Skipped as skipped:
                rows.append({**what, "peer": peer, "said": f"skipped: {skipped}"})
                continue
            settings[f"{peer} {made['version']}"] = str(made["settings"])
            rows.append({**what, "peer": f"{peer} {made['version']}", **compared(made["depth"], truth),
                         "seconds": float(made["seconds"]), "said": ""})
    return found_of(rows, {"scenes": list(scenes), "peers": list(peers), "settings": settings})


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The measurement of these rows."""
    columns = [Column("scene", "scene"), Column("triangles", "triangles", "1", "", "d"), Column("pixels", "pixels"),
               Column("peer", "renderer"), Column("missed", "other pixels", "1", "%", ".2g"),
               Column("median", "median", "m", "mm", ".2g"), Column("rms", "rms", "m", "mm", ".2g"),
               Column("worst", "worst", "m", "mm", ".2g"), Column("seconds", "CPU s a picture", "1", "", ".2g"),
               Column("said", "")]
    return Measurement.of("render", settings, [
        Table("Depth against rays in double precision: pixels of the outline that one of the two does not have, and "
              "the error of the others", columns, rows, name="render")],
        notes=[f"{peer}: {said}" for peer, said in settings["settings"].items()])
