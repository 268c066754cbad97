"""The two surfaces of a pair: positions, blended normals, candidates, the patch of a step, and the rest-state answer on
it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree

from vsfsim.physics.contact import pair_points as pair_contact
from vsfsim.physics.contact import rigid_points as contact
from vsfsim.physics.contact.pair_links import Compliance
from vsfsim.physics.contact.relaxation import Relaxation
from vsfsim.physics.linear.rest_factor import Response, response
from vsfsim.physics.model import Model

_MARGIN = 0.3  # of a stride: by their own motion the surfaces may come nearer by so much in a step
# of the sensor's height: by so much the surfaces may come past where the free sensor goes, it by swelling sideways,
# they by bulging
_BULGE = 0.25
_AWAY = 0.5  # cosine between a face's normal and the way the sensor looks, over which the face has its back to it
_MOST_PARTS = 16  # along the edge of a face
_SMOOTH = 0.7  # cosine between the normals of two faces that meet smoothly: less is an edge, and stays one
_BARY = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])
_SLOPES = np.stack([  # derivatives of a quadratic face's shape functions along two of its edges, at its six nodes
    np.stack([1 - 4 * _BARY[:, 0], *((4 * _BARY[:, 1] - 1, 0 * _BARY[:, 0]) if k == 1
                                     else (0 * _BARY[:, 0], 4 * _BARY[:, 2] - 1)),
              4 * (_BARY[:, 0] - _BARY[:, 1]) if k == 1 else -4 * _BARY[:, 1],
              4 * (_BARY[:, 2] if k == 1 else _BARY[:, 1]),
              -4 * _BARY[:, 2] if k == 1 else 4 * (_BARY[:, 0] - _BARY[:, 2])], axis=1) for k in (1, 2)])
_SOFTEST = 1e-3  # of the sensor's modulus: least that its nodes' penalty is made for
# of the stiffness, for the object's nodes: the sensor's nodes bear the load, these only keep edges from poking in
# between them
_SECOND = 0.1
_TABLE = 1500  # unknowns of a sensor up to which its whole inverse answers faster on a CPU than its factor
SENSOR_NODES = 3000  # of a sensor that touches an object: its compliance is kept whole, (3 m)^2 doubles


@dataclass
class Side:
    """The nodes of one surface (Q of them) and the faces of the other one, numbers local to the touch; tensors on the
    device.

    first: number of the first node; they follow one another. facet: (B, Q, 3) corners of a face that each node is on.
    stiffness: (B, Q) [N/m].
    faces: of the other surface (B, F, 3 or 6). count: (B,) int32 faces in use. candidates: (B, Q, most) int32 faces
    that each node may meet in this step, -1 pads. state: what the kernels write, by name. memory: friction's.
    relaxation: friction's iteration in this step.
    views: the same tensors by name as Warp's arrays, made once: the tensors are only ever written in place.
    around: the corners (as face x nodes + node, -1 pads) that share each corner's node (B, F n, most). smooth: normals
    blended there (B, F, n, 3).
    """

    first: int
    facet: torch.Tensor
    stiffness: torch.Tensor
    faces: torch.Tensor
    count: torch.Tensor
    candidates: torch.Tensor
    state: dict[str, torch.Tensor]
    memory: dict[str, torch.Tensor]
    relaxation: Relaxation
    around: torch.Tensor
    smooth: torch.Tensor
    views: dict[str, wp.array]

    def arrays(self, names: str) -> list[wp.array]:
        """Views by their names, with spaces between them."""
        return [self.views[name] for name in names.split()]


def farthest(sensor: Model) -> float:
    """How far the sensor's surface reaches from the origin of its frame [m]."""
    return float(np.linalg.norm(sensor.mesh.points, axis=1).max())


def _around(faces: np.ndarray, count: np.ndarray, device: str) -> torch.Tensor:
    """Corners that share each corner's node, itself among them (B, F n, most), -1 pads; faces (B, F, n) of which the
    first ``count`` (B,) are in use."""
    batch, width, nodes = faces.shape
    tables = []
    for b in range(batch):
        if b and np.array_equal(faces[b], faces[b - 1]) and count[b] == count[b - 1]:
            tables.append(tables[-1])
            continue
        flat = faces[b, :count[b]].ravel()
        order = np.argsort(flat, kind="stable")
        valence = np.bincount(flat, minlength=1) if len(flat) else np.zeros(1, int)
        start = np.concatenate([[0], np.cumsum(valence)])
        table = np.full((width * nodes, max(1, int(valence.max()))), -1)
        for slot in range(table.shape[1]):
            has = valence[flat] > slot
            table[:len(flat)][has, slot] = order[start[flat[has]] + slot]
        tables.append(table)
    most = max(t.shape[1] for t in tables)
    return torch.as_tensor(np.stack([np.pad(t, ((0, 0), (0, most - t.shape[1])), constant_values=-1) for t in tables]),
                           device=device)


class PairSurfaces:
    """Both surfaces of B touches on the device: who may meet whom in a step, and how both bodies at rest answer forces
    on the patch that this makes.

    Arguments and attributes as `pair.PairTouching`.
    """

    rubs: bool

    def __init__(self, model: Model, sensor: Model, friction: float, poses: np.ndarray, *, device: str, stride: float):
        self.model, self.sensor, self.device = model, sensor, device
        self._margin = _MARGIN * stride
        self._reach = farthest(sensor)
        self.kernels = pair_contact.kernels()
        self.rubs, self._friction = friction > 0.0, float(friction)
        self.stick = contact.STICK
        self.batch = poses.shape[1]
        self._count = len(model.mesh.points)
        self._every = torch.arange(self.batch, device=device)
        self.softening = torch.ones(self.batch, dtype=torch.float64, device=device)
        inverse = sensor.factor.solve(np.diag(sensor.free))
        self._sensor_compliance = torch.as_tensor(0.5 * (inverse + inverse.T), device=device)
        self._sensor_single = self._sensor_compliance.to(torch.float32)
        self._upload(self._reachable(poses))

    # ------------------------------------------------------------------------------------------ set-up

    def _reachable(self, poses: np.ndarray) -> list[np.ndarray]:
        """Boundary triangles of the object that each touch's sensor may meet: those that its free surface, made
        thicker, sweeps over, and that do not look the way that the sensor looks. Every node counts: its columns of the
        inverse are solved for."""
        mesh, own = self.model.mesh, self.sensor.mesh.points
        margin = _BULGE * float(np.ptp(own[:, 2]))
        over = cKDTree(own[:, :2])
        spots = self._spots()
        corners = mesh.points[mesh.faces[:, :3]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        low, high = own.min(axis=0) - margin, own.max(axis=0) + margin
        out = []
        for b in range(self.batch):
            met = np.zeros(len(mesh.faces), bool)
            for pose in poses[:, b]:
                faces = np.flatnonzero(~met & (normal @ pose[:3, 2] < _AWAY))
                local = (spots[faces] - pose[:3, 3]) @ pose[:3, :3]
                face, spot = ((local > low) & (local < high)).all(axis=2).nonzero()
                local = local[face, spot]
                far, nearest = over.query(local[:, :2])
                met[faces[face[(far < margin + self.sensor.element_size) & (local[:, 2] < own[nearest, 2]
                                                                            + margin)]]] = True
            out.append(np.flatnonzero(met))
        return out

    def _spots(self) -> np.ndarray:
        """Places on every face of the object at rest (f, k, 3) [m], no further apart than half the sensor's size: faces
        may be larger than it."""
        corners = self.model.mesh.points[self.model.mesh.faces[:, :3]]
        longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
        parts = int(np.clip(np.ceil(2.0 * longest / float(np.ptp(self.sensor.mesh.points[:, :2], axis=0).min())), 2,
                            _MOST_PARTS))
        grid = np.array([(i, j, parts - i - j) for i in range(parts + 1) for j in range(parts + 1 - i)]) / parts
        return np.einsum("kc,fcx->fkx", grid, corners)

    def _upload(self, reach: list[np.ndarray]) -> None:
        mesh, own = self.model.mesh, self.sensor.mesh
        batch, m = self.batch, len(own.points)
        nodes = [np.unique(mesh.faces[f]) for f in reach]
        width = max(1, max(len(n) for n in nodes))
        most = max(1, max(len(f) for f in reach))
        listed = np.full((batch, width), -1, np.int64)
        faces = np.zeros((batch, most, 6), np.int32)
        normal_of = np.zeros((batch, width, 3), np.int32)
        tied = np.zeros((batch, width))
        area, modulus = mesh.face_area(), self.model.surface_modulus
        own_area, own_modulus = own.face_area(), self.sensor.surface_modulus
        soft = float(np.median(own_modulus))
        for b, (f, n) in enumerate(zip(reach, nodes, strict=True)):
            listed[b, :len(n)] = n
            if not len(f):
                continue
            local = np.searchsorted(n, mesh.faces[f])
            faces[b, :len(f)] = local
            # a node stands for a share of its faces; the softer body bounds the pressure, so it sets the stiffness
            w = contact.PENALTY * np.minimum(modulus[f], soft) * np.sqrt(area[f]) / 6.0
            np.add.at(tied[b], local, _SECOND * w[:, None])
            normal_of[b, local] = local[:, None, :3]
        # the same for the sensor's nodes; against what is far softer than it a softer penalty will do
        corners = own.faces.shape[1]
        object_modulus = np.array([np.median(modulus[f]) if len(f) else soft for f in reach])
        pressed = contact.PENALTY * np.minimum(own_modulus[None, :],
                                               np.maximum(object_modulus[:, None],
                                                          _SOFTEST * own_modulus[None, :])) * np.sqrt(own_area)
        carried_stiffness = np.zeros((batch, m))
        for b in range(batch):
            np.add.at(carried_stiffness[b], own.faces, pressed[b][:, None] / corners)
        carried_normal = np.zeros((m, 3), np.int64)
        carried_normal[own.faces] = own.faces[:, None, :3]
        at = own.faces + width

        def real(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(np.array(values), dtype=torch.float64, device=self.device)

        def whole(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(np.array(values), dtype=torch.int32, device=self.device)

        def many(values: np.ndarray) -> np.ndarray:
            return np.broadcast_to(values, (batch, *values.shape))

        self._sides = [
            self._side(width, whole(many(width + carried_normal)), real(carried_stiffness), whole(faces),
                       whole(np.array([len(f) for f in reach]))),
            self._side(0, whole(normal_of), real(tied), whole(many(at)), whole(np.full(batch, len(at)))),
        ]
        self._width = width
        # degrees of freedom and rest positions of all surface nodes: the object's in reach, then the sensor's
        rest = np.zeros((batch, width, 3))
        for b, n in enumerate(nodes):
            rest[b, :len(n)] = mesh.points[n]
        carried = 3 * (self._count + np.arange(m))[:, None] + np.arange(3)
        objects = np.where(listed[:, :, None] >= 0, 3 * listed[:, :, None] + np.arange(3), -1)
        self._dof = torch.as_tensor(np.concatenate([objects, many(carried)], axis=1), device=self.device)  # (B, S, 3)
        self._rest = real(np.concatenate([rest, many(own.points)], axis=1))
        free = real(np.concatenate([self.model.free, self.sensor.free]))
        self._free = free[self._dof.clamp(min=0)] * (self._dof >= 0)
        factor = self.model.factor.quick(mesh.points) if self.device == "cpu" else self.model.factor
        self._object: Response = response(factor, self._dof[:, :width].reshape(batch, -1), device=self.device,
                                          exact=False, lazy=True)
        self._object_compliance = self._object.compliance()
        self._x = self._rest.clone()
        self._x_before, self._x_swept = self._rest.clone(), self._rest.clone()
        self._near = torch.zeros((batch, width + m), dtype=torch.int32, device=self.device)
        self._moved_to: tuple[np.ndarray, torch.Tensor] | None = None
        # whose normals were blended once more in this step
        self._blended = torch.zeros(batch, dtype=torch.bool, device=self.device)

    def _side(self, first: int, facet: torch.Tensor, stiffness: torch.Tensor, faces: torch.Tensor,
              count: torch.Tensor) -> Side:
        size = tuple(stiffness.shape)

        def zeros(*more: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.zeros((*size, *more), dtype=dtype, device=self.device)

        state = {"gap": zeros() + 1e30, "face": zeros(dtype=torch.int32) - 1, "shape": zeros(6), "normal": zeros(3),
                 "push": zeros(3), "drag": zeros(3), "way": zeros(3),
                 "rows": zeros(3, 3), "slips": zeros(dtype=torch.int32), "astray": zeros(dtype=torch.int32),
                 "energy": zeros()}
        memory = {"anchored": zeros(dtype=torch.int32), "anchor_face": zeros(dtype=torch.int32),
                  "anchor_shape": zeros(6), "limit": zeros(), "across": zeros(3)}
        relaxation = Relaxation(size, self.device)
        candidates = zeros(pair_contact.CANDIDATES, dtype=torch.int32) - 1
        smooth = torch.zeros((*faces.shape, 3), dtype=torch.float64, device=self.device)
        k = self.kernels
        types = {"shape": k.vec6, "anchor_shape": k.vec6, "rows": k.mat33,
                 **dict.fromkeys(("normal", "push", "drag", "way", "across", "smooth"), k.vec3)}
        facet, faces = facet.contiguous(), faces.contiguous()
        named = {"facet": facet, "stiffness": stiffness, "faces": faces, "count": count, "candidates": candidates,
                 "smooth": smooth, **state, **memory}
        return Side(first, facet, stiffness, faces, count, candidates, state, memory, relaxation,
                    _around(faces.cpu().numpy(), count.cpu().numpy(), self.device), smooth,
                    {**{name: wp.from_torch(t, dtype=types.get(name)) for name, t in named.items()},
                     **dict(zip(("anchorings", "damping", "change", "miss"), relaxation.arrays(), strict=True))})

    # ------------------------------------------------------------------------------------------ poses and history

    def _positions(self, u: torch.Tensor, pose: np.ndarray) -> torch.Tensor:
        """World positions (B, S, 3) [m] of all surface nodes for displacements u (3 N, B) and the sensor at ``pose``
        (B, 4, 4)."""
        index = self._dof.clamp(min=0).reshape(self.batch, -1)
        moved = u.gather(0, index.T).T.reshape(self._rest.shape).to(torch.float64) * (self._dof >= 0)
        out = self._rest + moved
        out[:, self._width:] = self._to_world(out[:, self._width:], pose)
        return out

    def _to_world(self, x: torch.Tensor, pose: np.ndarray) -> torch.Tensor:
        at = torch.as_tensor(pose, dtype=torch.float64, device=self.device)
        return x @ at[:, :3, :3].mT + at[:, None, :3, 3]

    def carried(self, vectors: torch.Tensor, *, place: bool) -> torch.Tensor:
        """Vectors (m, 3, B) of the sensor's frame in the world, or points of it if ``place``, at the present pose."""
        out = torch.einsum("bij,mjb->mib", self._turn, vectors)
        return out + torch.as_tensor(self._pose[:, :3, 3].T, device=self.device) if place else out

    def begin(self, before: np.ndarray, u: torch.Tensor) -> None:
        """A step begins: the sensor at ``before`` (B, 1, 4, 4), displacements u (3 N, B) [m]. Friction counts way from
        here."""
        self._u_before, self._pose_before = u.clone(), before[:, 0]
        for side in self._sides:
            side.relaxation.begin()
        self._x_before.copy_(self._positions(u, before[:, 0]))

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> None:
        """The sensor is at ``pose`` (B, 1, 4, 4) from now on: what may meet what in this step is looked up for the
        touches ``columns`` (k,); of the others nothing moves."""
        pose = pose[:, 0]
        if self._moved_to is not None and np.array_equal(self._moved_to[0],
                                                         pose) and torch.equal(self._moved_to[1], self._u_before):
            return
        self._moved_to = (pose.copy(), self._u_before)
        self._pose = pose
        self._turn = torch.as_tensor(pose[:, :3, :3], dtype=torch.float64, device=self.device)
        self._x_swept.copy_(self._positions(self._u_before, pose))
        self._x[columns] = self._x_swept[columns]
        self._blended[columns] = False
        way = np.linalg.norm((pose - self._pose_before)[:, :3, 3],
                             axis=1) + self._reach * np.linalg.norm((pose - self._pose_before)[:, :3, :3], axis=(1, 2))
        self._look_up(float(way.max()) + self._margin, columns, blend=columns)

    def _look_up(self, within: float, columns: torch.Tensor, *, blend: torch.Tensor) -> None:
        """Candidates no further than ``within`` [m] from each node of ``columns`` (k,) at the present positions, and
        the patch that they make;
        ``blend``: which of them get new normals, too (j,)."""
        k = self.kernels
        x = wp.from_torch(self._x, dtype=k.vec3)
        every, some = (wp.from_torch(which.to(torch.int32)) for which in (self._every, columns))
        self._near.zero_()
        for side in self._sides:
            size = side.stiffness.shape
            wp.launch(k.search, dim=(size[1], len(columns)), device=self.device,
                      inputs=[some, within, side.first, *side.arrays("stiffness faces count"), x,
                              *side.arrays("candidates")])
            if len(blend):
                side.smooth[blend] = self._blend(side)[blend]
            wp.launch(k.mark, dim=(size[1], size[0]), device=self.device, inputs=[
                side.faces.shape[2], every, side.first, *side.arrays("faces candidates anchored anchor_face"),
                                                                                  wp.from_torch(self._near)])
        self._make_patch()

    def _blend(self, side: Side) -> torch.Tensor:
        """Normals at the nodes of the other surface's faces (B, F, n, 3), blended over the faces around a node that
        meet smoothly there."""
        batch, faces, nodes = side.faces.shape
        at = torch.arange(batch, device=self.device)[:, None, None]
        x = self._x[at, side.faces.long()]  # (B, F, n, 3)
        first, second = x[:, :, 1] - x[:, :, 0], x[:, :, 2] - x[:, :, 0]
        if nodes == 3:
            own = torch.linalg.cross(first, second)[:, :, None].expand(-1, -1, 3, -1)
        else:
            slope = torch.as_tensor(_SLOPES, device=self.device)  # (2, 6 places, 6 nodes)
            own = torch.linalg.cross(*(torch.einsum("pn,bfnc->bfpc", s, x) for s in slope))
        own = torch.nn.functional.normalize(own, dim=3).reshape(batch, faces * nodes, 3)
        others = own[at, side.around.clamp(min=0)]  # (B, F n, most, 3)
        counts = (side.around >= 0) & ((others * own[:, :, None]).sum(dim=3) > _SMOOTH)
        return torch.nn.functional.normalize((others * counts[..., None]).sum(dim=2),
                                             dim=2).view(batch, faces, nodes, 3)

    def _make_patch(self) -> None:
        width = self._width
        chosen = []
        for start, stop in ((0, width), (width, self._near.shape[1])):
            near = self._near[:, start:stop]
            most = max(1, int(near.sum(dim=1).amax()))
            on, order = torch.sort(near, dim=1, descending=True, stable=True)
            chosen.append((order[:, :most] + start, on[:, :most] > 0))
        self._split = chosen[0][0].shape[1]
        nodes, on = torch.cat([c[0] for c in chosen], dim=1), torch.cat([c[1] for c in chosen], dim=1)
        self._nodes, self._on = nodes, on
        place = torch.full(self._near.shape, 0, dtype=torch.int64, device=self.device)
        self._place = place.scatter_(1, nodes, torch.arange(nodes.shape[1],
                                                            device=self.device).expand_as(nodes).contiguous())
        index = nodes[:, :, None].expand(-1, -1, 3)
        dof = torch.where(on[:, :, None], self._dof.gather(1, index), -1)
        self.dof = dof.flatten(1)
        self._index = self.dof.clamp(min=0)
        self.real = (self.dof >= 0).to(torch.float64)
        self.free = self._free.gather(1, index).flatten(1) * self.real
        self.rest = self._rest.gather(1, index).flatten(1) * self.real
        three = torch.arange(3, device=self.device)
        # degrees of freedom among the object's surface nodes in reach
        self._on_object = (3 * nodes[:, :self._split, None] + three).flatten(1)
        self._on_sensor = (3 * (nodes[:, self._split:, None] - width) + three).flatten(1)  # among all of the sensor's
        if self._object.prepare(self._near[:, :width] > 0):
            self._object_compliance = self._object.compliance()
        self.compliance = self._answers()
        self.response: Response = self
        self._contact: Any = None

    def _answers(self) -> Compliance:
        split = 3 * self._split
        rows = torch.arange(self.batch, device=self.device)[:, None, None]
        a, c = self._on_object, self._on_sensor
        free = self.free
        return Compliance(self._object_compliance[rows, a[:, :, None],
                                                  a[:, None, :]] * free[:, :split, None] * free[:, None, :split],
                          self._sensor_compliance[c[:, :, None],
                                                  c[:, None, :]] * free[:, split:, None] * free[:, None, split:])

    # ------------------------------------------------------------------------------------------ the rest-state answer

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Displacements (3 N, k) [m] of both bodies at rest under forces (3 N, k) [N] that are 0 where held."""
        n = 3 * self._count
        return torch.cat([self._object.solve(right[:n].contiguous()), self._sensor_solve(right[n:])])

    def _sensor_solve(self, right: torch.Tensor) -> torch.Tensor:
        if self.device == "cpu" and len(right) > _TABLE:
            return torch.as_tensor(self.sensor.factor.solve(right.contiguous().numpy()))
        if self.device == "cpu":
            # what comes from here is corrected: half the bytes to read
            return (self._sensor_single @ right.to(torch.float32)).to(right.dtype)
        return self._sensor_compliance @ right

    def patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Displacements (3 N, k) [m] under forces (k, 3 s) [N] on the patches of ``touches`` (k,)."""
        split = 3 * self._split
        force = force * self.real[touches]
        on_object = torch.zeros((len(touches), 3 * self._width), dtype=force.dtype,
                                device=self.device).scatter_add_(1, self._on_object[touches], force[:, :split])
        return torch.cat([self._object.patch(touches, on_object), self._sensor_patch(touches, force[:, split:])])

    def _sensor_patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """The sensor's part of `patch`."""
        at = self._on_sensor[touches]
        if self.device == "cpu" and len(self._sensor_single) <= _TABLE:
            # as `_sensor_solve`, and only what the patch pushes is read
            single = force.to(torch.float32)
            return torch.stack([f @ self._sensor_single[rows] for f, rows in zip(single, at, strict=True)],
                               dim=1).to(force.dtype)
        return self._sensor_solve(torch.zeros((len(touches), len(self._sensor_compliance)), dtype=force.dtype,
                                              device=self.device).scatter_add_(1, at, force).T)
