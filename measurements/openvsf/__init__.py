"""A palpation as openvsf records one: an arm presses a Punyo into springs at known points, and every reading follows
from f = -K u.

The workload of `vsfsim measure methods` with a real arm's joint angles and the Punyo's dome, so that openvsf and our
estimators can be asked for the same stiffnesses from the same numbers. This is not physics: the dome is rigid, and the
object is the model that is estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

from measurements.measurement import Progress
from measurements.openvsf.folder import Bubble, Model, Recorded, check_target, write_openvsf
from measurements.palpation import layer_with_inclusion
from measurements.workload import MEAN, NOISE, STD, Workload, volume_points
from vsfsim.core.errors import VsfError
from vsfsim.physics.bubble.shape import HEIGHT, POWER
from vsfsim.physics.mesh.membrane import READ_OUT, closed, ellipse
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm, load_arm
from vsfsim.robot.reach import Unreachable, follow
from vsfsim.vsf.observe import dense_force_rows, pressure_rows
from vsfsim.vsf.sticking import stick

TARE = 3
"""Frames without contact that a sequence begins with, as many as openvsf's tare takes."""
_SEMI_AXES = (0.05725, 0.040)  # m, of the rim
_PLACE = np.array([0.45, 0.0, 0.15])  # m: the middle of the object's top in the arm's frame
_EXTENT = np.array([0.12, 0.08])  # m: of the places that are pressed
_DEPTH, _TILT = 0.012, 0.2  # m, rad: of a press; as `palpate`
_APART = 0.010  # m: between the dome and the object in the frames of the tare; openvsf pads both shapes by a millimetre
_DRAWS = 20  # of a touch that the arm cannot make


@dataclass(frozen=True)
class Palpation:
    """Springs, and the arm's touches of them."""

    points: np.ndarray
    """The springs, world (n, 3) [m]."""
    stiffness: np.ndarray
    """Theirs (n,) [N/m]."""
    bubble: Bubble
    """The sensor."""
    q: tuple[np.ndarray, ...]
    """Joint angles of every touch (T, 7) [rad]."""
    poses: tuple[np.ndarray, ...]
    """Poses of the bubble's body in the world, of every touch (T, 4, 4) [m]."""
    unreachable: int
    """Draws of a touch that the arm could not make [-]."""

    @classmethod
    def of(cls, particles: int, touches: int, frames: int, *, seed: int = 0,
           progress: Progress = lambda _: None) -> Palpation:
        """About ``particles`` springs in the bench's volume under ``touches`` presses of ``frames`` frames, the first
        `TARE` free of contact.

        Raises:
            VsfError: a size below 1, fewer than two frames after the tare's, or a touch that no draw makes reachable.
        """
        if frames < TARE + 2:
            raise VsfError(f"openvsf: {frames} frames a touch; give at least {TARE + 2}, of which the first {TARE} are "
                           f"the tare's.")
        points, spacing = volume_points(particles, touches, frames)
        arm = load_arm(punyo=True)
        body = arm.links.index("punyo")
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        q, poses, missed = [], [], 0
        for touch in range(touches):
            if touch % 10 == 0:
                progress(f"touch {touch + 1} of {touches}: joint angles")
            for _ in range(_DRAWS):
                try:
                    q.append(_press(arm, rng, frames))
                    break
                except Unreachable:
                    missed += 1
            else:
                raise VsfError(f"openvsf: touch {touch} cannot be made by the arm in {_DRAWS} draws; try another seed "
                               f"than {seed}.")
            poses.append(arm.postures(q[-1]).links[:, body])
        rest = load_arm(punyo=True, tool="flange").postures(np.zeros((1, gen3.JOINTS)))
        mount = np.linalg.inv(rest.tool[0]) @ rest.links[0, body]
        return cls(points + _PLACE, layer_with_inclusion()(points) * spacing**3, punyo(mount), tuple(q), tuple(poses),
                   missed)

    def recorded(self, seed: int = 0) -> tuple[list[Recorded], Workload]:
        """Every touch as it is read, with noise; and the same readings as the bench's workload."""
        dome = self.bubble.triangles[:_dome_faces()]
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        out, pressures, forces = [], [], []
        n, count = len(self.points), len(self.bubble.vertices)
        for q, poses in zip(self.q, self.poses, strict=True):
            turn = poses[:, :3, :3]
            contacts = stick(self.points, np.einsum("tij,nj->tni", turn, self.bubble.vertices) + poses[:, None, :3, 3],
                             dome)
            dense = dense_force_rows(contacts, n, dome, count)
            into = pressure_rows(contacts.displacements(), n, turn[:, :, 2], area=self.bubble.area)
            world, pressure = (dense @ self.stiffness).reshape(len(q), count, 3), into @ self.stiffness
            force = np.einsum("tji,tnj->tni", turn, world)
            read = force + NOISE * rng.standard_normal(force.shape)
            felt = pressure + NOISE / self.bubble.area * rng.standard_normal(pressure.shape)
            out.append(Recorded(q, np.tile(self.bubble.vertices, (len(q), 1, 1)), read, felt, force, pressure))
            pressures.append(into)
            forces.append(dense)
        # The bench counts in newtons: a pressure times the area.
        w, area = sparse.vstack(pressures).tocsr(), self.bubble.area
        z = np.concatenate([np.einsum("tij,tnj->tni", poses[:, :3, :3], touch.force).ravel() for touch,
                            poses in zip(out, self.poses, strict=True)])
        frames = len(self.q[0])
        return out, Workload(area * w, area * np.concatenate([t.pressure for t in out]),
                             np.repeat(np.arange(len(out)), frames),
                             sparse.vstack(forces).tocsr(), z, 3 * count, frames)


def export(folder: Path, particles: int, touches: int, frames: int, *, urdf: Path | None = None, seed: int = 0,
           progress: Progress = lambda _: None) -> tuple[Workload, list[str]]:
    """Write a palpation for openvsf (see `measurements.openvsf.folder`): the same readings for our estimators, and what
    the user still has to do.

    Raises:
        VsfError: sizes that are too small. DatasetError: the folder is not empty or cannot be written, or the URDF is
        none of the arm.
    """
    check_target(folder, urdf)  # before minutes of joint angles
    palpation = Palpation.of(particles, touches, frames, seed=seed, progress=progress)
    recorded, load = palpation.recorded(seed)
    area = palpation.bubble.area
    to_do = write_openvsf(folder, recorded, palpation.bubble,
                          Model(palpation.points, palpation.stiffness, MEAN, STD, NOISE, NOISE / area, TARE), urdf=urdf)
    if palpation.unreachable:
        to_do.append(f"{palpation.unreachable} draws of a touch were out of the arm's reach and were drawn again.")
    return load, to_do


def punyo(mount: np.ndarray) -> Bubble:
    """A Punyo's free dome, of the published read-out mesh's numbers of nodes, over its base."""
    a, b = _SEMI_AXES
    flat, faces, rim = ellipse(a, b, READ_OUT[0], rim=READ_OUT[1])
    height = HEIGHT * np.clip(1.0 - (flat[:, 0] / a) ** 2 - (flat[:, 1] / b) ** 2, 0.0, None) ** POWER
    height[rim] = 0.0
    z = np.array(gen3.PUNYO_AXIS) / np.linalg.norm(gen3.PUNYO_AXIS)
    x = np.array(gen3.PUNYO_LONG_AXIS) - z * (z @ np.array(gen3.PUNYO_LONG_AXIS))
    x /= np.linalg.norm(x)
    vertices = gen3.PUNYO_RIM_CENTRE + np.column_stack([flat, height]) @ np.stack([x, np.cross(z, x), z])
    p = vertices[faces][:, :, :2]
    e, f = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    return Bubble(vertices, closed(faces, rim), mount, float(0.5 * (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]).sum()))


def _dome_faces() -> int:
    """Triangles of the dome, before those of the base (Euler's formula)."""
    return 2 * (READ_OUT[0] - 1) - READ_OUT[1]


def _press(arm: Arm, rng: np.random.Generator, frames: int) -> np.ndarray:
    """Joint angles (frames, 7) [rad] of one press at a random place, its long axis along the arm's y."""
    place = _PLACE + np.append(rng.uniform(-0.5, 0.5, 2) * _EXTENT, 0.0)
    lean = rng.uniform(-_TILT, _TILT, 2)
    c, s = np.cos(lean), np.sin(lean)
    about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    turn = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]]) @ about_x
    down = turn @ np.array([0.0, 0.0, -1.0])
    # the tool's z goes down; its x is the rim's long axis
    x = turn @ np.array([0.0, 1.0, 0.0])
    way = np.concatenate([-np.linspace(_APART + 0.005 * (TARE - 1), _APART, TARE),
                          np.linspace(-0.002, _DEPTH, frames - TARE)])
    poses = np.tile(np.eye(4), (len(way), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = np.stack([x, np.cross(down, x), down], axis=1), place + way[:, None] * down
    return follow(arm, poses, table=None)
