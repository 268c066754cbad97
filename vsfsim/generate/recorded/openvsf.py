"""Recordings of real plants and shoes in the layout of openvsf, as a dataset without truth.

    FOLDER/OBJECT/seq*/kinova_state.npy or angles.npy               (T, 7)     joint angles of a Gen3 [rad]
                       kinova_joint_torques.npy or torques.npy      (T, 7)     [N m]; plants
                       punyo_pressure.npy or pressure.npy           (T, 1)     shoes
                       punyo_state.npy or punyo_curr_pts.npy        (T, N, 3)  vertices, its body frame [m]; or none
                       punyo_force.npy                              (T, N, 3)  on the bubble, same frame [N]; or none
    OBJECT/bg_pcd.pcd                coloured cloud, world [m]
    OBJECT/rgbd_factory_config.yaml  bbox [low, high] of the object and view.origin, the camera's centre, world [m]
    OBJECT/openvsf.yaml              optional: world.punyo, its mesh and its mount

The cloud and its box may lie in a folder of assets of their own. A recorded torque is sum J^T f - G, f the contacts'
forces on the arm and G what holds the arm against its weight; G is added, and the mean of the tare's frames subtracted.
Source: github uiuc-iml/openvsf @29d70e9 (multi_modal_dataset.py, joint_torque_sensor.py, reformat_dataset.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.dome import Dome
from vsfsim.core.errors import DatasetError, MeshError, one_of
from vsfsim.core.extras import require
from vsfsim.core.plain_text import from_json
from vsfsim.core.shape import ProbeShape
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, Touch, View
from vsfsim.generate.aim import cloud_normals
from vsfsim.generate.recorded.clouds import read_pcd, view_of_cloud
from vsfsim.generate.recorded.written import SPLIT, nothing_known, recorded_touch, write_recorded
from vsfsim.physics.mesh.formats import parse
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm, chain_of

CLOUD, BOX, WORLD, ABOUT = "bg_pcd.pcd", "rgbd_factory_config.yaml", "openvsf.yaml", "manifest.json"
TARE = {"torque": 20, "pressure": 10}
"""Frames without contact at the start of a sequence that openvsf's own configurations take their tare from."""
UNITS = {"hPa": 100.0, "Pa": 1.0}
GAUGE = 7820.0
"""Gauge pressure of a free dome where nobody measured it [Pa]: E h = 680 N/m times 11.5 per metre (docs/physics.md)."""
_MET = 5.0  # a reading that is so many standard deviations of the tare's frames from them has met the object
_NAMES = {"q": ("kinova_state", "angles"), "torque": ("kinova_joint_torques", "torques"),
          "pressure": ("punyo_pressure", "pressure"), "state": ("punyo_state", "punyo_curr_pts"),
          "force": ("punyo_force",)}


@dataclass(frozen=True)
class Options:
    """How a folder is read."""

    assets: Path | None = None
    """Folder with the cloud and the box of each OBJECT; None: they lie in its own folder."""
    bubble: Path | None = None
    """Mesh of the free bubble in its body frame (PLY or OBJ) [m]; None: what `WORLD` names."""
    pressure_unit: str = "hPa"
    """Of the files, one of `UNITS`."""
    tare: int | None = None
    """Frames without contact at the start of each sequence; None for `TARE`."""
    every: int = 1
    """Of the frames after the tare, each so many-th is kept."""


def import_openvsf(folder: Path, out: Path, options: Options = Options()) -> Dataset:
    """Write a dataset of recordings: readings and pictures, an empty truth, and no contact force where none was read.

    Args:
        folder: of one object or of several, each with its sequences. out: the new folder, which appears whole or not
        at all. options: how it is read.

    Raises:
        DatasetError: no sequence, a file that is missing or has another shape, objects of both kinds, or the new folder
            exists.
        MissingPackage: mujoco or PyYAML is not installed.
    """
    one_of(options.pressure_unit, UNITS, "--pressure-unit", DatasetError)
    objects = _objects(folder)
    kinds = {_kind(sequences[0]) for sequences in objects.values()}
    if len(kinds) > 1:
        raise DatasetError(f"{folder} holds objects touched by the arm (torques) and by the bubble "
                           "(pressure); give two folders, one of each.")
    (kind,) = kinds
    views = [_view(number, place, sequences, kind, options)
             for number, (place, sequences) in enumerate(objects.items())]
    return write_recorded(folder, out, views, f"recorded: {kind}, openvsf's layout, {len(views)} objects")


def _objects(folder: Path) -> dict[Path, list[Path]]:
    """The folder of each object and its sequences."""
    if not folder.is_dir():
        raise DatasetError(f"{folder} is no folder. Give the one that holds the sequences (seq*), "
                           "or a folder of them for each object.")
    places = [folder, *sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("seq"))]
    out = {place: sorted(p for p in place.glob("seq*") if p.is_dir()) for place in places}
    out = {place: found for place, found in out.items() if found}
    if not out:
        raise DatasetError(f"{folder} holds no sequence: neither it nor a folder in it has folders "
                           f"named seq*, each with {_NAMES['q'][0]}.npy and "
                           f"{_NAMES['torque'][0]}.npy or {_NAMES['pressure'][0]}.npy.")
    return out


def _file(sequence: Path, key: str) -> Path | None:
    """The array of a sequence that is called ``key`` here."""
    return next((path for name in _NAMES[key] if (path := sequence / f"{name}.npy").is_file()), None)


def _kind(sequence: Path) -> str:
    for kind in ("pressure", "torque"):
        if _file(sequence, kind):
            return kind
    raise DatasetError(f"{sequence} has neither {' or '.join(_NAMES['torque'])}.npy (an arm that "
                       f"touches plants) nor {' or '.join(_NAMES['pressure'])}.npy (a bubble).")


def _read(sequence: Path, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """One array of a sequence; None in a shape is any length."""
    path = _file(sequence, key)
    if path is None:
        raise DatasetError(f"{sequence} has no {' or '.join(f'{name}.npy' for name in _NAMES[key])}.")
    try:
        found = np.load(path, allow_pickle=False)
        found = np.asarray(found, np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path} cannot be read as an array of numbers: {error}.") from error
    if key == "pressure" and found.ndim == 1:
        found = found[:, None]
    if found.ndim != len(shape) or any(w not in (None, n) for n, w in zip(found.shape, shape)) or not len(found):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise DatasetError(f"{path} has the shape {found.shape}; ({wanted}) is needed.")
    if not np.isfinite(found).all():
        frame = int(np.argwhere(~np.isfinite(found))[0][0])
        raise DatasetError(f"{path} is not finite in frame {frame}. Cut the sequence there, or mend that frame.")
    return found


def _view(number: int, place: Path, sequences: list[Path], kind: str, options: Options) -> ObjectView:
    shown = _picture(place, options)
    tare = TARE[kind] if options.tare is None else options.tare
    bubble = _Bubble.of(place, options) if kind == "pressure" else None
    arm = Arm(punyo=bubble is not None, tool=None if bubble is None else "flange")
    cloud, eye = shown.points(), shown.camera_pose[:3, 3]
    touches = []
    for sequence in sequences:
        q = _read(sequence, "q", (None, gen3.JOINTS))
        if len(q) <= tare:
            raise DatasetError(f"{sequence} has {len(q)} frames, and the first {tare} are its "
                               "tare, free of contact. Give the number of such frames by --tare.")
        keep = np.r_[tare - 1:len(q):options.every] if tare else np.r_[0:len(q):options.every]
        make = _torques if bubble is None else bubble.fields
        fields, met = make(sequence, arm, q, tare, options)
        fields = {name: value[keep] if name in _PER_FRAME else value for name, value in fields.items()}
        touches.append(_touch(fields, met[keep], keep, cloud, eye))
    probe: ProbeShape = chain_of(arm) if bubble is None else bubble.dome
    name = place.resolve().name
    return ObjectView(name, number, 0, SPLIT, probe, shown, tuple(touches), nothing_known(
        f"{name} is a real object, recorded in {len(sequences)} sequences"))


_PER_FRAME = ("mount_pose", "q", "torque", "pressure", "node_position", "node_force", "force")


def _touch(fields: dict[str, Any], met: np.ndarray, frame: np.ndarray, cloud: np.ndarray, eye: np.ndarray) -> Touch:
    """A recorded touch; ``met`` (T,) says how far each reading is from the tare's, over its deviation there."""
    poses, frames = fields["mount_pose"], len(frame)
    deepest = int(np.argmax(met))
    way = poses[deepest, :3, 3] - poses[0, :3, 3]
    length = float(np.linalg.norm(way))
    target = cloud[np.argmin(np.linalg.norm(cloud - poses[deepest, :3, 3], axis=1))]
    # the way of an arm that was recorded stands for its plan, which nobody recorded
    plan = {} if "torque" not in fields else {"planned_time": frame.astype(float),
                                              "planned_pose": poses, "planned_q": fields["q"],
                                              "planned_frame": np.arange(frames)}
    return recorded_touch(
        time=frame.astype(float), axis=way / length if length > 1e-6 else poses[deepest, :3, 2], target=target,
        normal=cloud_normals(cloud, target[None], eye)[0], touched=bool(met[deepest] > _MET),
        **{"force": np.full((frames, 3), np.nan), **plan, **fields})


def _off_tare(values: np.ndarray, tare: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (T, d) without the mean of the tare's frames, and how far each is from it over its deviation (T,)."""
    if not tare:
        return values, np.linalg.norm(values, axis=1) / 1e-9
    out = values - values[:tare].mean(axis=0)
    spread = np.sqrt((out[:tare] ** 2).sum(axis=1).mean())
    return out, np.linalg.norm(out, axis=1) / max(float(spread), 1e-9)


def _torques(sequence: Path, arm: Arm, q: np.ndarray, tare: int, options: Options) -> tuple[dict[str, Any], np.ndarray]:
    read = _read(sequence, "torque", (len(q), gen3.JOINTS))
    weight = np.zeros_like(q) if _without_weight(sequence.parent) else arm.gravity_torque(q)
    torque, met = _off_tare(read + weight, tare)
    return {"mount_pose": arm.postures(q).tool, "q": q, "torque": torque}, met


def _without_weight(place: Path) -> bool:
    """Whether the torques of an object are those of the contact alone, as in our own exports."""
    try:
        return from_json((place / ABOUT).read_text()).get("torques") == "contact"
    except (OSError, ValueError, AttributeError):
        return False


@dataclass(frozen=True)
class _Bubble:
    """The sensor: its free dome in the mount's frame, and where that is."""

    dome: Dome
    """The free membrane."""
    body_to_mount: np.ndarray
    """Pose of the sensor's body in the mount's frame (4, 4) [m]."""
    flange_to_body: np.ndarray
    """Pose of the flange in the body's frame (4, 4) [m]."""

    @classmethod
    def of(cls, place: Path, options: Options) -> _Bubble:
        world = _yaml(place / WORLD).get("world") if (place / WORLD).is_file() else None
        said = world.get("punyo") if isinstance(world, Mapping) else None
        said = said if isinstance(said, Mapping) else {}
        mesh = options.bubble or (place / str(said["file_name"]) if "file_name" in said else None)
        if mesh is None:
            raise DatasetError(f"{place}: nothing names the mesh of the bubble. Give it by --bubble; openvsf has it as "
                               f"knowledge/robot_model/punyo_mesh_complete.ply.")
        try:
            found = parse(mesh.read_bytes(), mesh)
        except (OSError, MeshError) as error:
            raise DatasetError(f"the mesh of the bubble cannot be read: {error}. Give it by --bubble.") from error
        mount, rim = _on_arm()
        turn = np.array(said.get("parent_relative_transform", mount), float)
        if turn.shape != (4, 4):
            raise DatasetError(f"{place / WORLD}: parent_relative_transform of punyo has the shape "
                               f"{turn.shape}; (4, 4) is needed.")
        inward = np.linalg.inv(rim)
        points = found.vertices @ inward[:3, :3].T + inward[:3, 3]
        kept = found.faces[~(np.abs(points[found.faces][:, :, 2]) < 1e-3).all(axis=1)]  # a closed mesh has a base
        if not len(kept) or not 0.01 < points[:, 2].max() < 0.1:
            raise DatasetError(f"{mesh} reaches {1e3 * points[:, 2].max():.1f} mm over the rim of "
                               "a Punyo; it must be its dome in the body's frame, in metres.")
        return cls(Dome.of(points, kept), inward, turn)

    def fields(self, sequence: Path, arm: Arm, q: np.ndarray, tare: int,
               options: Options) -> tuple[dict[str, Any], np.ndarray]:
        read = _read(sequence, "pressure", (len(q), 1))
        pressure = read * UNITS[options.pressure_unit]
        if np.abs(pressure).max() > 3e5:
            raise DatasetError(f"{sequence}: a pressure is {read.max():.6g} {options.pressure_unit}, which is three "
                               f"atmospheres and more; give its unit by --pressure-unit.")
        change, met = _off_tare(pressure, tare)
        body = arm.postures(q).tool @ self.flange_to_body
        out: dict[str, Any] = {"mount_pose": body @ np.linalg.inv(self.body_to_mount), "q": q,
                               "pressure": GAUGE + change[:, 0], "rest_pressure": GAUGE}
        state, force = (_read(sequence, key, (len(q), len(self.dome.points), 3))
                        if _file(sequence, key) else None for key in ("state", "force"))
        turn = body[:, :3, :3]
        if state is not None:
            out["node_position"] = (np.einsum("tij,tnj->tni", turn, state) + body[:, None, :3, 3]).astype(np.float32)
            out["node_rest"], out["node_triangles"] = self.dome.points, self.dome.faces
        if force is not None:
            turned = np.einsum("tij,tnj->tni", turn, force).astype(np.float32)
            out["force"] = turned.astype(float).sum(axis=1)
            if state is not None:
                out["node_force"] = turned
        return out, met


def _on_arm() -> tuple[np.ndarray, np.ndarray]:
    """Poses (4, 4) [m] of the sensor's body in the flange's frame, and of the mount's frame in the body: middle of the
    rim, x along its long axis, z along the dome's."""
    flange, rim = (Arm(punyo=True, tool=tool).postures(np.zeros((1, gen3.JOINTS))) for tool in ("flange", "punyo_rim"))
    return np.linalg.inv(flange.tool[0]) @ flange.links[0, -1], np.linalg.inv(rim.links[0, -1]) @ rim.tool[0]


def _picture(place: Path, options: Options) -> View:
    assets = place if options.assets is None else options.assets / place.resolve().name
    if not (assets / CLOUD).is_file() or not (assets / BOX).is_file():
        raise DatasetError(f"{assets} has no {CLOUD} and {BOX}: the coloured cloud of the object, "
                           "and its box and the camera's place. Where they lie in another folder, "
                           "one folder an object, give it by --assets.")
    table = _yaml(assets / BOX)
    try:
        low, high = np.array(table["bbox"], float)
        eye = np.array(table["view"]["origin"], float)
        if low.shape != (3,) or eye.shape != (3,) or not (low < high).all():
            raise ValueError("bbox must be [low, high] and view.origin one place, in metres")
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{assets / BOX} has no bbox [[x, y, z], [x, y, z]] and view: {{origin: "
                           f"[x, y, z]}} in metres: {error!r}.") from error
    points, colours = read_pcd(assets / CLOUD)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    try:
        return view_of_cloud(points, colours, inside, eye)
    except DatasetError as error:
        raise DatasetError(f"{assets / BOX}: {error}") from error


def _yaml(path: Path) -> dict[str, Any]:
    require("export", "yaml")
    import yaml

    class Loader(yaml.SafeLoader):
        """Their paths have tags of openvsf's own."""

    Loader.add_multi_constructor("!", lambda loader, _, node: loader.construct_scalar(node))
    try:
        table = yaml.load(path.read_text(), Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DatasetError(f"{path} cannot be read as YAML: {error}.") from error
    if not isinstance(table, dict):
        raise DatasetError(f"{path} is no table.")
    return table

