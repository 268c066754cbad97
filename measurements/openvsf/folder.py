"""The folder that the published openvsf package (github uiuc-iml/openvsf @29d70e9) loads: one `.npy` a key and
sequence, a point VSF, a mesh, a configuration.

    seq_<ID>/kinova_state.npy     (T, 7)      joint angles [rad]
             punyo_state.npy      (T, N, 3)   vertices of the bubble, in its body frame [m]
             punyo_force.npy      (T, N, 3)   force ON the bubble, in its body frame [N]
             punyo_pressure.npy   (T, 1)      -(1/A) sum f . z_punyo [Pa], A the bubble's area projected along z
    object/vsf_empty.npz          points (n, 3) float64, world [m]; K (n,) [N/m], all zero
    assets/punyo.ply              the undented bubble, closed, in its body frame [m]
    openvsf.yaml                  for `punyo_force`; openvsf-pressure.yaml for `punyo_pressure`
    ground_truth/                 what openvsf does not look at: the true VSF, and every reading without its noise
    manifest.json                 units, law, noise, and what is missing

The first frames of a sequence are free of contact, since openvsf takes its tare there. The robot is theirs: its URDF
and meshes are not ours to ship.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.data.disk import write_atomic

LINKS = ("Shoulder_Link", "HalfArm1_Link", "HalfArm2_Link", "ForeArm_Link", "SphericalWrist1_Link",
         "SphericalWrist2_Link", "Bracelet_Link")
"""Of the Gen3 in openvsf's URDF, with a joint each."""
FLANGE = "EndEffector_Link"
URDF = "assets/kinova_gen3.urdf"
MESH = "assets/punyo.ply"
_ORIGIN = "knowledge/robot_model/kinova_gen3.urdf of github uiuc-iml/openvsf, whose meshes lie beside it"


@dataclass(frozen=True)
class Recorded:
    """One touch of T frames."""

    q: np.ndarray
    """Joint angles (T, 7) [rad]."""
    state: np.ndarray
    """Positions of the bubble's vertices in its body frame (T, N, 3) [m]."""
    force: np.ndarray
    """Forces on them, same frame, with noise (T, N, 3) [N]."""
    pressure: np.ndarray
    """With noise (T,) [Pa]."""
    true_force: np.ndarray
    """Without noise (T, N, 3) [N]."""
    true_pressure: np.ndarray
    """Without noise (T,) [Pa]."""


@dataclass(frozen=True)
class Bubble:
    """The sensor."""

    vertices: np.ndarray
    """Of the undented bubble in its body frame (N, 3) [m]."""
    triangles: np.ndarray
    """Closed, wound outwards (F, 3)."""
    mount: np.ndarray
    """Pose of that frame in the flange's (4, 4) [m]."""
    area: float
    """Base area, projected along its z [m^2]."""


@dataclass(frozen=True)
class Model:
    """What is to be estimated, and from what."""

    points: np.ndarray
    """Rest positions, world (n, 3) [m]."""
    stiffness: np.ndarray
    """The truth (n,) [N/m]."""
    mean: float
    """Of the prior [N/m]."""
    std: float
    """Standard deviation of the prior [N/m]."""
    force_noise: float
    """Standard deviation of every component of a force [N]."""
    pressure_noise: float
    """Standard deviation of a pressure [Pa]."""
    tare: int
    """Frames without contact at the start of every sequence."""


def write_openvsf(folder: Path, touches: Sequence[Recorded], bubble: Bubble, model: Model, *,
                  urdf: Path | None = None) -> list[str]:
    """Write the folder.

    Args:
        folder: new or empty. touches: at least one. urdf: of the robot, to be named in the configuration where it lies;
        None: the user puts it to `URDF`.

    Returns:
        What the user still has to do, sentence by sentence.

    Raises:
        DatasetError: the folder has something in it or cannot be written, the URDF is none of a Gen3, or no touch, or
        touches of other shapes.
    """
    if not touches:
        raise DatasetError("openvsf: there is no touch to write; it needs at least one.")
    count = len(bubble.vertices)
    for number, touch in enumerate(touches):
        frames = len(touch.q)
        shapes = {"q": (frames, 7), "state": (frames, count, 3), "force": (frames, count, 3), "pressure": (frames,),
                  "true_force": (frames, count, 3), "true_pressure": (frames,)}
        odd = [f"{name} {getattr(touch, name).shape}, not {shape}" for name,
               shape in shapes.items() if getattr(touch, name).shape != shape]
        if odd or frames <= model.tare:
            raise DatasetError(f"openvsf: touch {number} has "
                               f"{'; '.join(odd) or f'{frames} frames, no more than the {model.tare} of the tare'}.")
    robot, to_do = check_target(folder, urdf)
    try:
        for part in ("object", "assets", "ground_truth"):
            (folder / part).mkdir()
        _write_vsf(folder / "object" / "vsf_empty.npz", model.points, np.zeros(len(model.points)))
        _write_vsf(folder / "ground_truth" / "vsf.npz", model.points, model.stiffness)
        write_atomic(folder / MESH, _ply(bubble.vertices, bubble.triangles))
        # openvsf sorts the names as strings
        digits = max(4, len(str(len(touches) - 1)))
        for number, touch in enumerate(touches):
            name = f"seq_{number:0{digits}d}"
            _write_keys(folder / name, {"kinova_state": touch.q, "punyo_state": touch.state, "punyo_force": touch.force,
                                        "punyo_pressure": touch.pressure[:, None]})
            _write_keys(folder / "ground_truth" / name, {"punyo_force": touch.true_force,
                                                         "punyo_pressure": touch.true_pressure[:, None]})
        for name, dense in (("openvsf.yaml", True), ("openvsf-pressure.yaml", False)):
            write_atomic(folder / name, _configuration(robot, bubble, model, count,
                                                       frames=sum(len(t.q) for t in touches), dense=dense).encode())
        write_atomic(folder / "manifest.json", (json.dumps(_manifest(touches, bubble, model, to_do),
                                                           indent=1) + "\n").encode())
    except OSError as error:
        raise DatasetError(f"openvsf: '{folder}' cannot be written: {error}. Give a folder that "
                           f"can be made.") from error
    return to_do


def check_target(folder: Path, urdf: Path | None) -> tuple[str, list[str]]:
    """Make the folder; how the configuration names the robot, and what the user still has to do for it.

    Raises:
        DatasetError: the folder has something in it or cannot be made, or the URDF is none of a Gen3.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            # openvsf loads every seq* in the folder, also those of an earlier run
            raise DatasetError(f"openvsf: '{folder}' is not empty. Give a new folder, or empty it.")
    except OSError as error:
        raise DatasetError(f"openvsf: '{folder}' cannot be written: {error}. Give a folder that "
                           f"can be made.") from error
    if urdf is None:
        return f"!relative_path {URDF}", [f"{URDF} is not ours to ship. Copy it there from {_ORIGIN}, or write the "
                                          f"export again with the path of yours (--urdf)."]
    try:
        text = urdf.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"openvsf: the URDF '{urdf}' cannot be read: {error}. It is {_ORIGIN}.") from error
    missing = [name for name in (*LINKS, FLANGE) if f'name="{name}"' not in text]
    if missing:
        raise DatasetError(f"openvsf: the URDF '{urdf}' has no {', '.join(missing)}; openvsf's sensors know the links "
                           f"by these names. It is {_ORIGIN}.")
    return json.dumps(str(urdf.resolve())), []


def _write_vsf(path: Path, points: np.ndarray, stiffness: np.ndarray) -> None:
    content = io.BytesIO()
    # Single precision points end openvsf in its sensors and its quadratic program.
    np.savez(content, points=np.asarray(points, np.float64), K=np.asarray(stiffness, np.float64), axis_mode="isotropic",
             features=np.array({}, dtype=object))
    write_atomic(path, content.getvalue())


def _write_keys(folder: Path, keys: dict[str, np.ndarray]) -> None:
    folder.mkdir()
    for key, value in keys.items():
        content = io.BytesIO()
        np.save(content, np.asarray(value, np.float64))
        write_atomic(folder / f"{key}.npy", content.getvalue())


def _ply(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    head = ["ply", "format ascii 1.0",
            "comment vsfsim: the free dome of a Punyo and its base, metres, in the bubble's body frame",
            f"element vertex {len(vertices)}",
            *(f"property double {axis}" for axis in "xyz"), f"element face {len(triangles)}",
            "property list uchar int vertex_indices", "end_header"]
    # repr keeps every digit: the mesh is the one that was pressed
    return "\n".join([*head, *(" ".join(map(repr, map(float, v))) for v in vertices),
                      *(f"3 {a} {b} {c}" for a, b, c in triangles), ""]).encode()


def _configuration(robot: str, bubble: Bubble, model: Model, count: int, *, frames: int, dense: bool) -> str:
    key, kind, noise = ("punyo_force", "PunyoDenseForceSensor",
                        model.force_noise) if dense else ("punyo_pressure", "PunyoPressureSensor", model.pressure_noise)
    shape = f"[[{count}, 3], float64]"
    mount = ", ".join(f"[{', '.join(repr(float(x)) for x in row)}]" for row in bubble.mount)
    # Dense forces are never tared there; openvsf fails if they are asked to be.
    tare = "calibrators: {}" if dense else f"calibrators:\n  punyo_pressure: {{type: tare, num_samples: {model.tare}}}"
    return f"""# What openvsf's scripts/point_vsf_estimate.py --batch reads; made by vsfsim, see manifest.json.
world:
  kinova: {{type: robot, file_name: {robot}}}
  punyo:
    type: deformable
    file_name: !relative_path {MESH}
    parent_name: {FLANGE}
    parent_relative_transform: [{mount}]
simulator:
  type: quasistatic
  deformables:
    vsf:
      model: {{type: point, path: !relative_path object/vsf_empty.npz}}
      config: {{friction_mu: 0.5, sim_slide: False, slide_step: 0.0001,
               geometry_padding1: 0.001, geometry_padding2: 0.001}}
sensors:
  {key}: {{name: {key}, type: {kind}, attachment_name: punyo}}
{tare}
dataset:
  keys: {{kinova_state: 7, punyo_state: {shape}, {key}: {shape if dense else 1}}}
  control_keys: {{kinova: kinova_state, punyo: punyo_state}}
  sensor_keys: {{{key}: {key}}}
estimator: {{optimizer: quad_prog, max_buffer_length: {max(100_000, frames)}, down_sample_rate: 1}}
# An observation's std is 1 in its own unit there, so that only ratios count: var = (std of K / std of the noise)^2.
prior: {{type: gaussian, mu: {model.mean!r}, var: {(model.std / noise) ** 2!r}}}
"""


def _manifest(touches: Sequence[Recorded], bubble: Bubble, model: Model, to_do: list[str]) -> dict[str, object]:
    return {
        "made_for": "github uiuc-iml/openvsf @29d70e9",
        "sequences": len(touches), "frames": sum(len(t.q) for t in touches), "tare_frames_a_sequence": model.tare,
            "points": len(model.points),
        "frames_of_reference": "world: the arm's Base_Link, z up; punyo_state and punyo_force: the bubble's body",
        "law": "force on the bubble by point i: -K_i (p_i - p_i0), p_i stuck to the point of the surface that met it; "
               "a vertex takes the barycentric share of its triangle's points",
        "pressure_law": "-(1/A) sum f . z of the bubble's body", "A_m2": bubble.area,
        "noise_std": {"punyo_force_N": model.force_noise, "punyo_pressure_Pa": model.pressure_noise},
            "prior_N_per_m": {"mean": model.mean, "std": model.std},
        "ground_truth": "ground_truth/vsf.npz: the true K; ground_truth/seq_*: the readings without noise",
        "not_here": ["kinova_joint_torques: a contact on the bubble gives none in openvsf", *to_do]}
