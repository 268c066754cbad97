"""The two sides of a pair of deformable surfaces: the nodes of one surface, and the faces of the other one that they
may meet.

Both bodies are at rest here; `PairContact` moves them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from vsfsim.physics.contact.kernels import bound
from vsfsim.physics.contact.pair.kernels import CANDIDATES, Points
from vsfsim.physics.contact.patch import PENALTY, face_grid
from vsfsim.physics.mesh.quadratic import face_slopes
from vsfsim.physics.model import Model

_BULGE = 0.25
"""Part of `scale` by which a surface may leave the space that the free sensor passes through: the sensor swells
sideways, and the object bulges."""
_FLAT = 0.3
"""Part of its least half width below which the height of a sensor says nothing about how far it may move: a slack
skin is flat, and is pressed in until its housing stops it."""
_AWAY = 0.5  # cosine between a face's normal and the sensor's axis above which the face has its back to the sensor
_MOST_PARTS = 16  # along the edge of a face
_SMOOTH = 0.7  # cosine between the normals of two faces that meet smoothly; faces that meet at an edge have a lower one
_LEAST_MODULUS = 1e-3  # of the sensor's modulus: for softer objects the penalty of its nodes decreases no further
_SECOND = 0.1
"""Factor on the stiffness of the object's nodes: the sensor's nodes bear the load, the object's only keep its edges
from passing between them."""
_BARY = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])
_SLOPES = np.moveaxis(face_slopes(_BARY), 2, 0)
"""Derivatives of the shape functions of a quadratic face at its six nodes (2, 6 places, 6 nodes)."""


@dataclass
class Side:
    """The nodes of one surface (Q) and the faces of the other one (F), of B touches; node numbers are those of a touch.

    All tensors are only ever written in place.
    """

    tensors: dict[str, torch.Tensor]
    """All of them by name, as the struct ``Points`` of the kernels says, without the axis of the one point of a node.
    """
    around: torch.Tensor
    """Corners that share the node of each corner (B, F n, most), as face x n + node with n nodes a face; -1 is
    padding."""
    first: int
    """Number of the first node; the others follow it."""
    points: Any
    """That struct."""

    def blended(self, x: torch.Tensor) -> torch.Tensor:
        """`smooth` at the positions x (B, S, 3) [m] of all nodes."""
        batch, faces, nodes = self.tensors["faces"].shape
        at = torch.arange(batch, device=x.device)[:, None, None]
        x = x[at, self.tensors["faces"].long()]  # (B, F, n, 3)
        first, second = x[:, :, 1] - x[:, :, 0], x[:, :, 2] - x[:, :, 0]
        if nodes == 3:
            own = torch.linalg.cross(first, second)[:, :, None].expand(-1, -1, 3, -1)
        else:
            slope = torch.as_tensor(_SLOPES, device=x.device)  # (2, 6 places, 6 nodes)
            own = torch.linalg.cross(*(torch.einsum("pn,bfnc->bfpc", s, x) for s in slope))
        own = torch.nn.functional.normalize(own, dim=3).reshape(batch, faces * nodes, 3)
        others = own[at, self.around.clamp(min=0)]  # (B, F n, most, 3)
        counts = (self.around >= 0) & ((others * own[:, :, None]).sum(dim=3) > _SMOOTH)
        return torch.nn.functional.normalize((others * counts[..., None]).sum(dim=2),
                                             dim=2).view(batch, faces, nodes, 3)


def make_sides(model: Model, sensor: Model, reach: Sequence[np.ndarray], nodes: Sequence[np.ndarray], width: int,
               both: Mapping[str, Any], *, device: str) -> tuple[Side, Side]:
    """The sensor's nodes against the object's faces, and the object's nodes against the sensor's faces.

    Args:
        model: the object.
        sensor: the body with the touching surface.
        reach: boundary triangles of the object that each touch may meet, see `reachable`.
        nodes: their nodes, increasing; they come first in the numbers of a touch.
        width: their largest number; the sensor's nodes come after them.
        both: what both sides share, by its names in ``Side`` of the kernels.
        device: Warp device.
    """
    mesh, own = model.mesh, sensor.mesh
    batch, m = len(reach), len(own.points)
    faces = np.zeros((batch, max(1, max(len(f) for f in reach)), 6), np.int32)
    # of the object's nodes and of the sensor's
    stiffness, facet = ([np.zeros((batch, n, *more), kind) for n in (width, m)]
                        for more, kind in (((), float), ((3,), np.int64)))
    area, modulus, own_modulus = mesh.face_area(), model.surface_modulus, sensor.surface_modulus
    soft = float(np.median(own_modulus))
    for b, (f, n) in enumerate(zip(reach, nodes, strict=True)):
        local = faces[b, :len(f)] = np.searchsorted(n, mesh.faces[f])
        # the softer body bounds the pressure, so it sets the stiffness
        softer = np.maximum(np.median(modulus[f]) if len(f) else soft, _LEAST_MODULUS * own_modulus)
        for k, (own_faces, of_pressure, size) in enumerate((
                (local, _SECOND * np.minimum(modulus[f], soft), area[f]),
                (own.faces, np.minimum(own_modulus, softer), own.face_area()))):
            # a node has a share of its faces
            share = PENALTY * of_pressure * np.sqrt(size) / own_faces.shape[1]
            np.add.at(stiffness[k][b], own_faces, share[:, None])
            facet[k][b, own_faces] = own_faces[:, None, :3]
    at = np.broadcast_to(own.faces + width, (batch, *own.faces.shape))
    return (_side(width, width + facet[1], stiffness[1], faces, [len(f) for f in reach], both, device),
            _side(0, facet[0], stiffness[0], at, [len(own.faces)] * batch, both, device))


def _side(first: int, facet: np.ndarray, stiffness: np.ndarray, faces: np.ndarray, count: Sequence[int],
          both: Mapping[str, Any], device: str) -> Side:
    # every node is a part with one point: beside the corners of a face that it is on, the fourth node of the part
    batch, n = stiffness.shape
    node = np.broadcast_to(first + np.arange(n)[:, None], (batch, n, 1))
    points, tensors = bound(Points, {
        **both, "corners": faces.shape[2], "stiffness": stiffness[:, :, None], "faces": faces,
        "local": np.concatenate([facet, node, node, node], axis=2), "shape": np.tile(np.eye(6)[3], (batch, n, 1, 1)),
        "count": np.array(count), "candidates": np.full((batch, n, CANDIDATES), -1),
        "smooth": np.zeros((*faces.shape, 3)), "onset": 0.0, "terms": np.zeros(1),
        "coefficient": np.full(faces.shape[1], both["coefficient"])}, (batch, n, 1), device)
    tensors["gap"].fill_(1e30)
    tensors["owner"].fill_(-1)
    around = torch.as_tensor(_around(np.asarray(faces), count), device=device)
    return Side({name: t[:, :, 0] if t.shape[2:3] == (1,) else t for name, t in tensors.items()}, around, first, points)


def _around(faces: np.ndarray, count: Sequence[int]) -> np.ndarray:
    """`Side.around` of faces (B, F, n) of which the first ``count`` (B) are in use."""
    batch, width, nodes = faces.shape
    tables = []
    for b in range(batch):
        flat = faces[b, :count[b]].ravel()
        order = np.argsort(flat, kind="stable")
        node = flat[order]
        slot = np.arange(len(node)) - np.searchsorted(node, node)
        corners = np.full((flat.max(initial=0) + 1, slot.max(initial=0) + 1), -1)
        corners[node, slot] = order
        table = np.full((width * nodes, corners.shape[1]), -1)
        table[:len(flat)] = corners[flat]
        tables.append(table)
    most = max(t.shape[1] for t in tables)
    return np.stack([np.pad(t, ((0, 0), (0, most - t.shape[1])), constant_values=-1) for t in tables])


def scale(sensor: Model) -> float:
    """Length [m] by which ways of a sensor are measured: its height, or 0.3 of its least half width if it is flatter
    (12 mm of a Punyo without air)."""
    size = np.ptp(sensor.mesh.points, axis=0)
    return float(max(size[2], _FLAT * 0.5 * size[:2].min()))


def reachable(model: Model, sensor: Model, poses: np.ndarray) -> list[np.ndarray]:
    """Boundary triangles of the object that each touch's sensor may meet (B).

    They are those that the free sensor's surface, thickened by a margin, passes through on its way, and that do not
    face away from it. The set is kept small, since a column of the inverse is solved for every node of it.

    Args:
        model: the object.
        sensor: the body with the touching surface.
        poses: sensor to world (T, B, 4, 4), no further apart than `scale`.
    """
    mesh, own = model.mesh, sensor.mesh.points
    margin = _BULGE * scale(sensor)
    over = cKDTree(own[:, :2])
    spots = _spots(model, sensor)
    corners = mesh.points[mesh.faces[:, :3]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    low, high = own.min(axis=0) - margin, own.max(axis=0) + margin
    out = []
    for b in range(poses.shape[1]):
        met = np.zeros(len(mesh.faces), bool)
        for pose in poses[:, b]:
            faces = np.flatnonzero(~met & (normal @ pose[:3, 2] < _AWAY))
            local = (spots[faces] - pose[:3, 3]) @ pose[:3, :3]
            face, spot = ((local > low) & (local < high)).all(axis=2).nonzero()
            local = local[face, spot]
            far, nearest = over.query(local[:, :2])
            inside = (far < margin + sensor.element_size) & (local[:, 2] < own[nearest, 2] + margin)
            met[faces[face[inside]]] = True
        out.append(np.flatnonzero(met))
    return out


def _spots(model: Model, sensor: Model) -> np.ndarray:
    """Places on every face of the object at rest (f, k, 3) [m], at most half the sensor's width apart: a face may be
    larger than the sensor."""
    corners = model.mesh.points[model.mesh.faces[:, :3]]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    parts = int(np.clip(np.ceil(2.0 * longest / float(np.ptp(sensor.mesh.points[:, :2], axis=0).min())), 2,
                        _MOST_PARTS))
    return np.einsum("kc,fcx->fkx", face_grid(parts, 3), corners)


def farthest(sensor: Model) -> float:
    """How far the sensor's surface reaches from the origin of its frame [m]."""
    return float(np.linalg.norm(sensor.mesh.points, axis=1).max())
