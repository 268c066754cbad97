"""A soft sensor that is carried against a soft object: both find one equilibrium, frame by frame.

The unknowns are the displacements of the object (world) and of the sensor (its own frame, in which its elements and
its rest-state factor stay the same while it is carried along). `PairContact` is the contact between them; everything
else is `Solver`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.pair.contact import PairContact, PairFactors
from vsfsim.physics.contact.pair.sides import farthest, scale
from vsfsim.physics.model import Model
from vsfsim.physics.solve import increments
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.newton import State
from vsfsim.physics.solve.touches import Rows, Solver

# of the sensor's `scale`: way in one step. With 0.15 a wall that is met lies in the nearer part still, but rubber that
# sticks to foam needs shorter ways: of 40 frames of touches of `bag-punyo` four end unbalanced, with this none
_STRIDE = 0.06
_BACK = 0.15  # likewise: how deep a sensor may be in the object where its path begins
_MARGIN = 0.045  # likewise: how far the surfaces approach each other in a step by their own motion


def side_by_side(model: Model, sensor: Model) -> Model:
    """An object (world) and a sensor (its frame) as one body whose boundary is the object's: the sensor's nodes follow
    the object's N in all, and its own weight is left out."""
    count = len(model.mesh.points)
    moved = tuple(replace(block, nodes=block.nodes + np.int32(count)) for block in sensor.blocks)
    return replace(
        model, mesh=replace(model.mesh, points=np.concatenate([model.mesh.points, sensor.mesh.points])),
        blocks=(*model.blocks, *moved), free=np.concatenate([model.free, sensor.free]),
        load=np.concatenate([model.load, np.zeros_like(sensor.free)]), soft_factor=None,
        factor=PairFactors(model.preconditioner, sensor.factor))  # type: ignore[arg-type]


class CoupledSolver(Solver):
    """Touches of one object by one soft sensor.

    Args:
        model: the object, in the world.
        sensor: the sensor in its own frame, +z towards the object; its displacements are 0 in the free state.
        friction: Coulomb's coefficient of the pair [-].
        device, options: see `Solver`.
    """

    def __init__(self, model: Model, sensor: Model, *, friction: float = 0.0, device: str = "cpu",
                 options: SolverOptions | None = None):
        self._setup(side_by_side(model, sensor), np.array([farthest(sensor)]), np.array([float(friction)]), device,
                    options, False)
        self.object, self.sensor = model, sensor
        # a sensor that has just lost contact balances its own gas to that force only, however small the object's are
        self._floor = max(model.least_force(), 100.0 * sensor.least_force())
        self._stride = _STRIDE * scale(sensor)

    def run(self, poses: np.ndarray, *, start: np.ndarray | None = None, keep: bool = False,
            progress: Callable[[int], None] | None = None) -> Frames:
        """Follow the sensor through all frames.

        Args:
            poses: sensor to world (T, B, 4, 4).
            start: where its path begins (B, 4, 4), see `Solver.run`.
            keep, progress: see `Solver.run`; with ``keep``, ``self.sensor_position`` holds T entries (m, 3, B) of the
                sensor's nodes in the world [m], and ``self.sensor_force`` the contact force on each (m, 3, B) [N].

        Returns:
            The frames; ``force`` is the one on the sensor. ``self.pressure`` [Pa] and ``self.volume`` [m^3] hold T
            entries (B,) of a sensor with gas.
        """
        self.pressure: list[np.ndarray] = []
        self.volume: list[np.ndarray] = []
        self.sensor_position: list[np.ndarray] = []
        self.sensor_force: list[np.ndarray] = []
        return super().run(poses, start=start, keep=keep, progress=progress)

    def _make_contact(self, poses: np.ndarray, start: np.ndarray | None = None) -> tuple[PairContact, np.ndarray]:
        start = poses[0] if start is None else start.reshape(poses.shape[1:])
        # what lies between two distant frames may be met, too
        way = [start, *(pose for ends in pairwise([start, *poses])
                        for pose in increments.pieces(*ends, scale(self.sensor), self._reaches))]
        contact = PairContact(self.object, self.sensor, self.model.factor, float(self.friction[0]),
                              np.stack(way)[:, :, 0], device=self.device, margin=_MARGIN * scale(self.sensor))
        first, meets = start.copy(), self._meets(contact, start)
        first[meets, :, :3, 3] -= _BACK * scale(self.sensor) * first[meets, :, :3, 2]  # where it barely touches
        self._inside = meets & self._meets(contact, first)
        for pose in increments.pieces(first, poses[0], self._stride, self._reaches):
            if self._meets(contact, pose).any():
                break
            first = pose
        return contact, first

    def _meets(self, contact: PairContact, pose: np.ndarray) -> np.ndarray:
        """Whether the bodies at rest touch at ``pose`` (B, 1, 4, 4), or one is within the other (B,) bool."""
        every = torch.arange(contact.batch, device=self.device)
        u = torch.zeros((len(self.model.free), contact.batch), dtype=torch.float64, device=self.device)
        contact.begin_step(pose, u, every)
        contact.move(pose, every)
        contact.evaluate(every, contact.gather(u))
        # the contact finds only nodes near the surface
        within = contact.touches(every) | (contact.wrong_side(every) > 0) | (contact.overlap(every, u) > 0.0)
        return within.cpu().numpy()

    def _start(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray, begin: torch.Tensor) -> None:
        """As of `Solver`; all points in contact begin stuck, as rubber mostly stays. Points that the step meets would
        slide freely, and Newton's method, to which a point that slips offers nothing along its slip, throws them past
        their anchors."""
        super()._start(columns, before, pose, begin)
        assert isinstance(self.contact, PairContact)
        self.contact.evaluate(columns, self.contact.gather(self._balance.u[:, columns], columns))
        self.contact.update_friction(columns)

    def _record(self, converged: np.ndarray) -> None:
        u, split = self._balance.u, 3 * len(self.object.mesh.points)
        self.history.append(u.clone().cpu().numpy())
        force = self._balance.contact_force().view(-1, 3, u.shape[1])
        force[:, :, torch.as_tensor(~converged, device=self.device)] = torch.nan
        self.surface_force.append(force[self.object.mesh.surface_nodes()].cpu().numpy())
        assert isinstance(self.contact, PairContact)
        carried = self.contact.carried_by
        self.sensor_force.append(carried(force[split // 3:], place=False).cpu().numpy())
        rest = torch.as_tensor(self.sensor.mesh.points, device=self.device)[:, :, None]
        self.sensor_position.append(carried(rest + u[split:].view(-1, 3, u.shape[1]), place=True).cpu().numpy())

    def _report(self, state: State) -> Rows:
        # the balance of the object only: the sensor's forces are in its own frame, and end at its rim
        own = {name: state[name].clone() for name in ("contact", "internal")}
        for values in own.values():
            values[3 * len(self.object.mesh.points):] = 0.0
        out = super()._report({**state, **own})
        if self.elasticity.pressure is not None:
            pressure = wp.to_torch(self.elasticity.pressure).cpu().numpy()
            self.pressure.append(np.where(out["converged"], pressure, np.nan))
            self.volume.append(wp.to_torch(self.elasticity.volume).cpu().numpy().copy())
        return out


def free_way(model: Model, sensor: Model, pose: np.ndarray, axis: np.ndarray) -> float:
    """How far the sensor can go from ``pose`` (4, 4) along the unit ``axis`` (3,) before it meets the object at rest
    [m]; infinite if it does not.

    Between flat facets: from every node of either surface to the other one.
    """
    own, at = sensor.mesh.points @ pose[:3, :3].T + pose[:3, 3], model.mesh.points
    sheet, skin = sensor.mesh.faces[:, :3], model.mesh.faces[:, :3]
    there = increments.ways(own[np.unique(sheet)], at[skin], axis)
    back = increments.ways(at[np.unique(skin)], own[sheet], -axis)
    return float(min(there.min(), back.min()))
