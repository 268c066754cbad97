"""How the force of a touch changes with the modulus of every element: one back-solve a touch and frame.

In equilibrium the elements' forces f balance those of the contact c, and the spring of a mount, of stiffness k, carries
F = a . sum of c along the press a. Elements and contact are as stiff as their modulus, so that d f / d log E_e is the
part f_e of element e, and c_e, of the contact points on it, likewise. With the tangent K of elements and contact and
the contact's change S a for a unit move of the probe, the implicit function theorem gives

    K l = g,   g = k / (k + a . S a) S a,
    dF / d log E_e = k / (k + a . S a) a . c_e + l . (f_e - c_e) + (l . S a) (a . c_e) / (k + a . S a)

so that l, the motion of the nodes when the mount goes in by a unit, is all that has to be solved for, whatever the
number of elements (the adjoint method; K is symmetric without friction). Without a spring k is infinite. The local
indentation (`contact.local_indentation`) is held where it is.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.core.shape import ProbeShape
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.newton import newton_direction
from vsfsim.physics.solve.touches import Known, Solver

_TOLERANCE, _ITERATIONS = 1e-4, 400  # of the back-solve's conjugate gradients [-]


class Sensitivity(Solver):
    """Touches by one rigid body without friction, with the derivatives of their forces.

    Args:
        model: the object.
        shape: the rigid body.
        axis: directions of the presses (B, 3) [-], along which their forces are read.
        options: limits.
        near: the same touches of the object with other moduli: their equilibria are where frames begin.
    """

    derivative: list[np.ndarray]
    """Of every frame of the last `run` with ``keep``: dF / d log E of each element (B, m) [N]; NaN where the frame is
    no equilibrium, or an unstable one."""

    def __init__(self, model: Model, shape: ProbeShape, axis: np.ndarray, *, options: SolverOptions,
                 near: Sensitivity | None = None):
        super().__init__(model, shape, options=options)
        self._axis = torch.as_tensor(np.asarray(axis, float))
        self._element = [_rows_in(model.mesh.tets, block.nodes) for block in model.blocks]
        self._near = [] if near is None else near._own
        self._own: list[Known] = []

    def run(self, poses: np.ndarray, **more: object) -> Frames:  # type: ignore[override]
        """See `Solver`."""
        self.derivative = []
        frames = super().run(poses, **more)  # type: ignore[arg-type]
        self._own = self._equilibria[len(self._near):]
        return frames

    def _record(self, converged: np.ndarray) -> None:
        balance, contact = self._balance, self.contact
        assert isinstance(contact, RigidContact)
        every, axis = balance.every, self._axis
        balance.evaluate(every)
        forces = [self.elasticity.of_elements(k).copy() for k in range(len(self.model.blocks))]
        pushed = contact.force[every]
        springs, near = contact.springs, torch.ones_like(every, dtype=torch.bool)
        change = (contact.own_stiffness(every, near) @ axis[:, None, :, None])[..., 0]  # (B, q, 3), S a
        stiff = (change * axis[:, None]).sum(dim=(1, 2))
        give = torch.ones_like(stiff) if springs is None else springs.stiffness / (springs.stiffness + stiff)
        right = spread(contact.dof, give[:, None] * contact.nodal_of(every, change) * contact.free, len(balance.u))
        self.elasticity.tangent(wp.from_torch(every.to(torch.int32)), wp.from_torch(balance.u), projected=False)
        moved, _, negative = newton_direction(
            self.elasticity, contact, every, right, near=near, tolerance=torch.full_like(stiff, _TOLERANCE),
            iterations=_ITERATIONS, factors=balance.factors)
        out = np.zeros((len(every), len(self.model.mesh.tets)))
        u = moved.numpy().reshape(-1, 3, len(every))
        for block, rows, force in zip(self.model.blocks, self._element, forces, strict=True):
            out[:, rows] = np.einsum("macb,macb->bm", u[block.nodes], force.reshape(*block.nodes.shape, 3, -1))
        at = contact.places(every, contact.gather(moved).view(len(every), -1, 3))  # l at the contact points (B, q, 3)
        along = (pushed * axis[:, None]).sum(dim=2)
        back = (at * change).sum(dim=(1, 2))
        rest = 0.0 if springs is None else (back / (springs.stiffness + stiff))[:, None] * along
        points = (give[:, None] * along - (at * pushed).sum(dim=2) + rest).numpy()
        for b, patch in enumerate(contact.patches):
            face = np.repeat(patch.parts["key"], 6)
            np.add.at(out[b], self.model.mesh.owner[face], points[b, :len(face)])
        out[~converged | negative.numpy()] = np.nan
        self.derivative.append(out)


def _rows_in(tets: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Where the rows ``some`` (k, 10) are among ``tets`` (m, 10): (k,)."""
    place = {tuple(row): k for k, row in enumerate(tets.tolist())}
    return np.array([place[tuple(row)] for row in some.tolist()], dtype=np.int64)
