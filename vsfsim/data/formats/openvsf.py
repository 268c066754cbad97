"""The folders that the published openvsf package loads, one of each object view of an arm's dataset.

    VIEW/seq_NNN/kinova_state.npy           (T, 7)  joint angles [rad]
    VIEW/seq_NNN/kinova_joint_torques.npy   (T, 7)  due to the contact [N m]
    VIEW/object/vsf_empty.npz               points (n, 3) float64, world [m]; K (n,) [N/m], all zero
    VIEW/openvsf.yaml                       configuration of its point_vsf_estimate.py
    VIEW/bg_pcd.pcd                         the visible cloud of the object with its colours, world [m]
    VIEW/rgbd_factory_config.yaml           its box and the camera's centre, for openvsf's VSFRGBDCameraFactory
    VIEW/manifest.json                      what openvsf does not ask: the torques are free of the arm's weight
    VIEW/ground_truth/                      the fitted VSF; openvsf does not look at it

A sequence begins with `TARE` copies of its first frame, which is free of contact, since openvsf takes its tare there.
Frames that did not converge are left out. Source: github uiuc-iml/openvsf @29d70e9.
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import View

TARE = 20
"""Frames without contact at the start of a sequence; openvsf's own number for joint torques."""


def export(dataset: Dataset, folder: Path) -> None:
    """Write the dataset into an empty folder.

    Raises:
        DatasetError: its touches are not an arm's.
    """
    yaml = Path(__file__).with_suffix(".yaml").read_text().replace("{{ tare }}", str(TARE))
    for view in dataset:
        if any(touch.q is None or touch.torque is None for touch in view.touches):
            raise DatasetError(f"export --to openvsf: {view.name} was not touched by an arm, and openvsf reads joint "
                               f"angles: a probe or a bubble that moves by itself has none. Use --to lerobot, "
                               f"webdataset or croissant, or export a dataset of a scene with [arm], e.g. "
                               f"plants-v5-mini.")
        place = folder / view.name
        (place / "object").mkdir(parents=True)
        (place / "ground_truth").mkdir()
        (place / "openvsf.yaml").write_text(yaml)
        _write_picture(place, view.view)
        (place / "manifest.json").write_text(json.dumps({
            "torques": "contact", "frames_of_reference": "world: the arm's Base_Link, z up",
            "made_from": {"scene": dataset.recipe.scene, "view": view.name, "sha256": dataset.sha256}}) + "\n")
        assert view.truth is not None
        points = np.asarray(view.truth.vsf_points, np.float64)
        for path, stiffness in ((place / "object" / "vsf_empty.npz", np.zeros(len(points))),
                                (place / "ground_truth" / "vsf.npz", view.truth.vsf_stiffness)):
            content = io.BytesIO()
            np.savez(content, points=points, K=np.asarray(stiffness, np.float64), axis_mode="isotropic",
                     features=np.array({}, dtype=object))
            path.write_bytes(content.getvalue())
        for index, touch in enumerate(view.touches):
            good = np.flatnonzero(touch.converged)
            if not len(good):
                continue
            rows = np.concatenate([np.full(TARE, good[0]), good])
            sequence = place / f"seq_{index:0{max(3, len(str(len(view.touches) - 1)))}d}"  # in the order of their names
            sequence.mkdir()
            for key, value in (("kinova_state", touch.q), ("kinova_joint_torques", touch.torque)):
                np.save(sequence / f"{key}.npy", np.asarray(value, np.float64)[rows])


def _write_picture(place: Path, shown: View) -> None:
    cloud, eye = shown.points(), shown.camera_pose[:3, 3]
    (place / "bg_pcd.pcd").write_bytes(pcd_bytes(cloud, shown.rgb[shown.mask]))
    box = [[round(float(x), 6) for x in corner] for corner in (cloud.min(axis=0) - 1e-3, cloud.max(axis=0) + 1e-3)]
    (place / "rgbd_factory_config.yaml").write_text(
        f"bbox: {box}\nview: {{origin: {[float(x) for x in eye]}}}\nvoxel_size: 0.005\n")


def pcd_bytes(points: np.ndarray, colours: np.ndarray) -> bytes:
    """A cloud as a binary PCD file: points (n, 3) [m] in single precision, colours (n, 3) uint8."""
    rows = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    for k, axis in enumerate("xyz"):
        rows[axis] = points[:, k]
    r, g, b = np.asarray(colours, np.uint32).T
    rows["rgb"] = r << 16 | g << 8 | b
    head = (f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
            f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n")
    return head.encode() + rows.tobytes()
