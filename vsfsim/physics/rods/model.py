"""From a plant to the arrays of the solver: section stiffnesses, frames, contact fibres, and the compliance at
rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.plant import Plant
from vsfsim.core.shape import Family
from vsfsim.core.shelf import family

SHEAR_ROUND, SHEAR_FLAT = 0.9, 5.0 / 6.0  # Timoshenko's shear factors of a round and a flat section
BLADE_SPACING = 0.008  # of fibres across a leaf blade [m]
MOST_FIBRES = 1300  # of a segment
# contact penalty over the stiffness of the plant at that point: the penetration is a thousandth of the deflection
STIFFER = 1000.0
PENALTY = (1e2, 1e8)  # limits of the penalty [N/m]
_ROUNDING = 2.2e-16


class RodError(VsfsimError):
    """The rod solver was given something it cannot work with."""


@dataclass(frozen=True)
class RodOptions:
    """Limits of the rod solver."""

    tolerance: float = 1e-4
    """Largest sum of unbalanced forces over the sum of the contact forces [-]."""
    force_floor: float = 1.0
    """Contact forces below this count as this in the tolerance [N]. With the defaults the error of a joint torque is
    below 0.1 mN m, a thousandth of the noise of its sensor."""
    force_limit: float = np.inf
    """Largest contact force [N]: a touch ends before the frame that exceeds it."""
    newton: int = 400
    """Newton iterations of one attempt at a stride; a branch that springs back takes many, whose length the free space
    limits."""
    work: int = 800
    """Newton iterations of a frame after which strides are no longer divided."""
    room: int = 512
    """Places for the contacts of a touch, three points of a fibre beside a capsule each."""
    share: int = 500
    """Newton iterations of a touch after which a launch ends, some seconds for a view on a core; bits do not depend on
    it."""


@dataclass(frozen=True)
class RodModel:
    """A plant ready to be solved, with n nodes and Q contact fibres. A fibre runs along a segment at a fixed offset
    from its middle line: one in a round branch, several across a blade. Where a branch ends, its tip is a fibre of no
    length. Entry 0 of what is of segments is not used."""

    plant: Plant
    """The plant that it was made from."""
    frame: np.ndarray
    """Rotation of each segment, its axis as the first column, a blade's width as the second (n, 3, 3)."""
    kd: np.ndarray
    """Axial and shear stiffnesses, see `kernels.segment` (n, 3) [N/m]."""
    kphi: np.ndarray
    """Torsional and bending stiffnesses, see `kernels.segment` (n, 3) [N m]."""
    arrays: dict[str, np.ndarray]
    """What the kernels are given of it, by the names of `structs.Trees`, where nodes and fibres of all plants are
    counted together."""
    penalty: np.ndarray
    """Contact penalty of 2 mm of each fibre (`kernels.fibre.CONTACT_LENGTH`), at the parent's end and at the child's
    (Q, 2) [N/m]."""
    compliance: np.ndarray
    """Displacement and spin of each node under a force and a moment there, at rest (n, 6, 6) [m/N and so on]."""

    def floor(self) -> float:
        """Bound on the rounding error of the sum of unbalanced forces [N]."""
        size = float(np.abs(self.plant.nodes).max())
        return 4.0 * _ROUNDING * size * float(self.kd.sum())

    def point_stiffness(self, segment: np.ndarray, along: np.ndarray, offset: np.ndarray,
                        direction: np.ndarray) -> np.ndarray:
        """Stiffness at rest of material points along unit directions (k, 3): (k,) [N/m], infinite where the plant does
        not move.

        Args:
            segment: segments of the material points (k,).
            along: their places along these, 0 to 1 (k,) [-].
            offset: their offsets from the middle line (k, 3) [m].
        """
        c = _point_compliance(self.plant, self.compliance, segment, along, offset)
        soft = np.einsum("ki,kij,kj->k", direction, c, direction)
        return np.where(soft > 0.0, 1.0 / np.where(soft > 0.0, soft, 1.0), np.inf)


def _point_compliance(plant: Plant, compliance: np.ndarray, segment: np.ndarray, along: np.ndarray,
                      offset: np.ndarray) -> np.ndarray:
    """Compliance of material points (k, 3, 3) [m/N], which move as `kernels.fibre` says."""
    parent = plant.parent[segment]
    way, s = plant.nodes[segment] - plant.nodes[parent], along[:, None]
    carry = _carry(way)
    cp, cc = compliance[parent], compliance[segment]
    share = (s**2 * (3.0 - 2.0 * s))[..., None]
    a = (1.0 - share) * _carry(offset + s / (1.0 + 2.0 * s) * way)[:, :3]
    b = share * _carry(offset - (1.0 - s) / (3.0 - 2.0 * s) * way)[:, :3]
    mixed = cp @ carry.transpose(0, 2, 1)
    cross = a @ mixed @ b.transpose(0, 2, 1)
    return a @ cp @ a.transpose(0, 2, 1) + b @ cc @ b.transpose(0, 2, 1) + cross + cross.transpose(0, 2, 1)


def build(plant: Plant, *, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> RodModel:
    """The rod model of a plant.

    Args:
        gravity: [m/s^2]. A plant with weight sags before it is touched, and is slower to solve: all of it is active in
        every frame.

    Raises:
        RodError: a segment is so wide that it has too many contact fibres.
    """
    n, length = len(plant.nodes), plant.lengths()
    frame = _frames(plant)
    kd, kphi = sections(plant)
    reach = np.zeros(n)
    for i in range(n - 1, 0, -1):
        reach[plant.parent[i]] = max(reach[plant.parent[i]], length[i] + reach[i])
    compliance = _compliance(plant, frame, kd, kphi)
    segment, offset, radius, tip = _fibres(plant, frame)
    wire = np.zeros((n, 2))
    if plant.yielding is not None:
        wire[1:] = plant.yielding[1:] / np.stack([length[1:], np.ones(n - 1)], axis=1)
    softest = np.stack([np.linalg.eigvalsh(_point_compliance(
        plant, compliance, segment, np.full(len(segment), end), offset))[:, -1] for end in (0.0, 1.0)], axis=1)
    penalty = np.clip(STIFFER / np.maximum(softest, 1e-30), *PENALTY)
    area = np.where(plant.half_width > 0.0, 4.0 * plant.half_width * plant.radius, np.pi * plant.radius**2)
    mass = np.zeros(n)
    np.add.at(mass, np.arange(1, n), 0.5 * (plant.density * area * length)[1:])
    np.add.at(mass, plant.parent[1:], 0.5 * (plant.density * area * length)[1:])
    child, sibling = _children(plant.parent)
    rank, level = _levels(plant.parent)
    return RodModel(plant, frame, kd, kphi, {
        "parent": plant.parent, "rest": plant.nodes, "frame": quaternions(frame), "length": length, "kd": kd,
        "kphi": kphi, "wire": wire, "load": mass[:, None] * np.asarray(gravity, float), "reach": reach,
        "bound": plant.radius + plant.half_width, "fibre": np.searchsorted(segment, np.arange(n)), "child": child,
        "next": sibling, "rank": rank, "level": level, "offset": offset, "radius": radius, "tip": tip.astype(np.int32),
    }, penalty, compliance)


def _children(parent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The child of each node with the highest number, and the sibling with the next lower one (n,); -1 for none."""
    child, sibling = np.full(len(parent), -1), np.full(len(parent), -1)
    for i in range(1, len(parent)):
        sibling[i] = child[parent[i]]
        child[parent[i]] = i
    return child, sibling


def _levels(parent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nodes sorted by level, their number of segments from the root (n,), and the first place of each level and the
    end (levels + 1,)."""
    depth = np.zeros(len(parent), int)
    for i in range(1, len(parent)):
        depth[i] = depth[parent[i]] + 1
    rank = np.argsort(depth, kind="stable")
    return rank, np.searchsorted(depth[rank], np.arange(depth.max() + 2))


def quaternions(rotation: np.ndarray) -> np.ndarray:
    """x y z w (..., 4) of rotations (..., 3, 3)."""
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat()
    return flat.reshape(*rotation.shape[:-2], 4)


def sections(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Stiffnesses kd (n, 3) [N/m] and kphi (n, 3) [N m] of the segments: axial, shear, shear; torsion, bending,
    bending.

    Round: A = pi r^2, I = pi r^4 / 4, J = 2 I. Blade of width w, thickness t: A = w t, I about its width w t^3 / 12,
    about its normal t w^3 / 12, J = w t^3 / 3 (thin). Axis 2 of the frame is the width, axis 3 the normal.
    """
    e, r, length = plant.young_modulus, plant.radius, np.where(plant.lengths() > 0.0, plant.lengths(), 1.0)
    shear = e / (2.0 * (1.0 + plant.poisson_ratio))
    flat = plant.half_width > 0.0
    w, t = 2.0 * plant.half_width, 2.0 * r
    area = np.where(flat, w * t, np.pi * r**2)
    i2 = np.where(flat, w * t**3 / 12.0, np.pi * r**4 / 4.0)
    i3 = np.where(flat, t * w**3 / 12.0, np.pi * r**4 / 4.0)
    j = np.where(flat, w * t**3 / 3.0, np.pi * r**4 / 2.0)
    factor = np.where(flat, SHEAR_FLAT, SHEAR_ROUND)
    # shear along axis 2 goes with bending about axis 3, and the other way round
    s2 = 1.0 / (1.0 / (factor * shear * area) + length**2 / (12.0 * e * i3))
    s3 = 1.0 / (1.0 / (factor * shear * area) + length**2 / (12.0 * e * i2))
    kd = np.stack([e * area, s2, s3], axis=1) / length[:, None]
    kphi = np.stack([shear * j, e * i2, e * i3], axis=1) / length[:, None]
    kd[0] = kphi[0] = 0.0
    return kd, kphi


def _frames(plant: Plant) -> np.ndarray:
    out = np.tile(np.eye(3), (len(plant.nodes), 1, 1))
    x = (plant.nodes[1:] - plant.nodes[plant.parent[1:]]) / plant.lengths()[1:, None]
    z = np.where((plant.half_width[1:] > 0.0)[:, None], plant.blade_normal[1:], np.eye(3)[np.abs(x).argmin(axis=1)])
    y = np.cross(z, x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    out[1:] = np.stack([x, y, np.cross(x, y)], axis=2)
    return out


def skew(v: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with skew(a) b = a x b."""
    return np.swapaxes(np.cross(v[..., None, :], np.eye(3)), -1, -2)


def _carry(way: np.ndarray) -> np.ndarray:
    """Matrices (k, 6, 6) from the displacement and spin of a point to those of a point rigidly attached at the offset
    ``way`` (k, 3)."""
    out = np.tile(np.eye(6), (len(way), 1, 1))
    out[:, :3, 3:] = -skew(way)
    return out


def _compliance(plant: Plant, frame: np.ndarray, kd: np.ndarray, kphi: np.ndarray) -> np.ndarray:
    """Compliance of each node at rest (n, 6, 6): that of its parent, carried along, plus that of the segment between.
    Other branches do not contribute."""
    n = len(plant.nodes)
    out = np.zeros((n, 6, 6))
    way = plant.nodes - plant.nodes[np.maximum(plant.parent, 0)]
    carry = _carry(way)
    half = 0.5 * skew(way)
    for i in range(1, n):
        d = frame[i] * kd[i] @ frame[i].T
        k = frame[i] * kphi[i] @ frame[i].T
        own = np.block([[d, d @ half[i]], [(d @ half[i]).T, half[i].T @ d @ half[i] + k]])
        out[i] = carry[i] @ out[plant.parent[i]] @ carry[i].T + np.linalg.inv(own)
    return out


def _fibres(plant: Plant, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Contact fibres: segment, offset [m], radius [m] and whether it is a tip, sorted by segment."""
    parts = []
    has_child = np.bincount(plant.parent[1:], minlength=len(plant.nodes)) > 0
    for i in range(1, len(plant.nodes)):
        across = 1 + 2 * int(np.ceil(plant.half_width[i] / BLADE_SPACING)) if plant.half_width[i] > 0.0 else 1
        side = np.linspace(-1.0, 1.0, across) * plant.half_width[i] if across > 1 else np.zeros(1)
        tip = np.repeat([False] if has_child[i] else [False, True], across)
        width = np.resize(side, len(tip))
        parts.append((np.full(len(tip), i), width[:, None] * frame[i][:, 1], np.full(len(tip), plant.radius[i]), tip))
        if len(tip) > MOST_FIBRES:
            widest = (MOST_FIBRES // 4 - 1) * BLADE_SPACING
            raise RodError(f"segment {i} of the plant is {2 * plant.half_width[i]:g} m wide: it has more contact "
                           f"fibres than a segment may have. A blade may be {2 * widest:g} m wide.")
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))  # type: ignore[return-value]


def grow(shape: Family, rng: np.random.Generator, *, where: str, number: int = 0) -> Plant:
    """The plant of a family, as object ``number`` of its dataset.

    Raises:
        SceneError: an unknown family, one that makes solid bodies, or a parameter that is wrong.
    """
    module = family(shape.name, where)
    if not hasattr(module, "grow"):
        raise SceneError(f"{where}: the family '{shape.name}' makes solid bodies; an arm touches plants so far. Use "
                         f"family = \"plant\", or take [arm] out and give a [probe].")
    return module.grow(shape.parameters, rng, where=where, number=number)
