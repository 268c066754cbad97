"""An arm in a dataset: a chain of links with capsules. Joint angles give poses, axes and anchors; NumPy alone, so that
a method needs no robot simulator."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import msgspec
import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.table import check_keys, typed, value

Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class ChainCapsule:
    """A capsule fixed to a link."""

    link: int
    """Number of the link."""
    start: tuple[float, float, float]
    """Centre of a half-sphere in the link's frame (3,) [m]."""
    stop: tuple[float, float, float]
    """Centre of the other half-sphere (3,) [m]."""
    radius: float
    """Of the capsule [m]."""


@dataclass(frozen=True)
class Chain:
    """L links in a row, each in its parent's frame; a joint turns its link about the link's own +z.

    As a "probe" of a dataset it is what touched the object; ``q`` of a touch gives the joint angles.
    """

    base: tuple[Row, Row, Row]
    """Pose of the first link in the world, 3 rows of 4 [m]."""
    positions: tuple[tuple[float, float, float], ...]
    """Of each link in its parent's frame (L, 3) [m]."""
    quaternions: tuple[Row, ...]
    """Of each link in its parent's frame, w x y z (L, 4) [-]."""
    joints: tuple[int, ...]
    """Number of the joint that turns each link, -1 for none (L,)."""
    capsules: tuple[ChainCapsule, ...]
    """K of them."""

    def __post_init__(self) -> None:
        if (not len(self.positions) == len(self.quaternions) == len(self.joints)
                or any(not 0 <= c.link < len(self.joints) for c in self.capsules)):
            raise ValueError(f"it has {len(self.positions)} positions, {len(self.quaternions)} quaternions and "
                             f"{len(self.joints)} joints; they must be as many, and capsules be on links of them")

    @property
    def dof(self) -> int:
        """Number of joints."""
        return max(self.joints) + 1

    def links(self, q: np.ndarray) -> np.ndarray:
        """Poses (T, L, 4, 4) [m] of the links at joint angles ``q`` (T, dof) [rad]."""
        from scipy.spatial.transform import Rotation  # inside: see core/rotation.py

        q = np.asarray(q, float)
        if q.ndim != 2 or q.shape[1] != self.dof:
            raise SceneError(f"joint angles have the shape {q.shape}; give (frames, {self.dof}) in radians.")
        out = np.tile(np.eye(4), (len(q), len(self.joints), 1, 1))
        pose = np.tile(np.eye(4), (len(q), 1, 1))
        pose[:, :3] = np.array(self.base)
        for i, joint in enumerate(self.joints):
            step = np.eye(4)
            step[:3, :3] = Rotation.from_quat(np.roll(self.quaternions[i], -1)).as_matrix()
            step[:3, 3] = self.positions[i]
            pose = pose @ step
            if joint >= 0:
                turn = np.tile(np.eye(4), (len(q), 1, 1))
                turn[:, 0, 0] = turn[:, 1, 1] = np.cos(q[:, joint])
                turn[:, 1, 0] = np.sin(q[:, joint])
                turn[:, 0, 1] = -turn[:, 1, 0]
                pose = pose @ turn
            out[:, i] = pose
        return out

    def joint_axes(self, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit axes and a point on each (T, dof, 3), (T, dof, 3) [m], of poses ``links`` (T, L, 4, 4)."""
        at = [self.joints.index(j) for j in range(self.dof)]
        return links[:, at][..., :3, 2], links[:, at][..., :3, 3]

    def capsule_poses(self, links: np.ndarray) -> np.ndarray:
        """Poses (T, K, 4, 4) [m] of the capsules, their middle as the origin and z along them."""
        local = np.stack([capsule_pose(np.array(c.start), np.array(c.stop)) for c in self.capsules])
        return links[:, [c.link for c in self.capsules]] @ local

    def moves(self, link: int) -> np.ndarray:
        """Whether each joint moves a link (dof,) bool."""
        return np.isin(np.arange(self.dof), self.joints[:link + 1])

    def table(self) -> dict[str, Any]:
        """As JSON values; `read_chain` takes them back."""
        return {**msgspec.to_builtins(self), "capsules": [[c.link, *c.start, *c.stop, c.radius] for c in self.capsules]}


def capsule_pose(start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a capsule: its middle, z from start to stop; any direction across will do, it is round."""
    z = (stop - start) / np.linalg.norm(stop - start)
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), 0.5 * (start + stop)
    return out


def read_chain(table: Any, where: str) -> Chain:
    """The chain of `Chain.table`.

    Raises:
        SceneError: a key is missing or unknown, or a list has another length.
    """
    rows = value(check_keys(table, f"{where} chain", [field.name for field in fields(Chain)]).get("capsules"),
                 list[tuple[int, *7 * [float]]], f"{where} chain: capsules")  # type: ignore[misc]
    return typed(table, Chain, f"{where} chain", also=("capsules",), capsules=tuple(
        ChainCapsule(row[0], row[1:4], row[4:7], row[7]) for row in rows))
