"""Which states lie on another solution branch than the equilibrium that a step begins from: a body has been let
through, or the object has snapped."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.physics.solve.frames import Reason
from vsfsim.physics.solve.newton import Equilibrium

SNAP = 0.05
"""Share of the energy that the bodies have put into the object, which a step may lose [-]."""
# share of that energy that makes a step doubtful, which can be made in shorter ones [-]: an equilibrium of a column
# that shorter steps find again lacks 0.61 % (4e730fe1e09e of the stability map), steps of a box on nu = 0.499 that they
# make otherwise 1.5 and 5 % (d9f35752c871)
_DOUBTFUL = 0.0075
_ROUNDING = 1e-4  # of the elastic energy, which a state balanced to a tier's tolerance may lack [-]
_SAME = 1e-2  # relative difference of least det F under which two crushed equilibria at one pose are the same
_SAME_ENERGY = 1e-4  # the same of the energy that the bodies have put into the object, under two doubtful ones


class SolutionBranch:
    """The equilibria that the steps of a batch of touches begin from.

    Made when no body touches the object yet, at the equilibrium under its weight.

    Args:
        balance: the touches; its ``least`` is set.
    """

    def __init__(self, balance: Equilibrium):
        self._balance = balance
        balance.elasticity.forces(wp.from_torch(balance.every.to(torch.int32)), wp.from_torch(balance.u))
        self._rest = self._stored(balance.every)
        self._kept = torch.full_like(balance.least, -float("inf"))  # energy that a step must keep [J]
        self._push = torch.zeros_like(balance.least)  # length of the force on the bodies where it begins [N]
        self._work = torch.zeros_like(balance.least)  # of that force along the step [J]
        self._way: torch.Tensor | None = None  # of the bodies in the step (B, K, 3) [m]
        self._smooth = _SmoothForce()
        self._crushed: dict[int, tuple[bytes, float]] = {}  # of touches: a pose and the least det F found there
        self._doubtful: dict[tuple[int, bytes], float] = {}  # energies found by a touch at a pose [J]

    def begin(self) -> None:
        """Begin a step: nothing is known of its equilibria."""
        self._crushed.clear()
        self._doubtful.clear()
        self._balance.least[:] = self._kept[:] = -float("inf")

    def bar(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray) -> None:
        """Bar states of ``columns`` (k,) that have less potential than the present equilibria, on the way to ``pose``.

        A body that moves on against the force on it does work, so without friction the potential grows. A state of less
        has let the body through, between the contact points or around it. With friction, which takes up work, no state
        is barred.

        Args:
            columns: touches (k,).
            before, pose: poses of the equilibria, and at the end of the step (B, K, 4, 4).
        """
        balance, contact = self._balance, self._balance.contact
        if not contact.solid:
            return
        contact.move(before, columns)
        state = balance.evaluate(columns)
        way = torch.as_tensor((pose - before)[..., :3, 3], device=balance.device)
        force = contact.on_bodies(columns)
        if not contact.has_friction:
            self._smooth.begin(columns, torch.as_tensor(before[..., :3, 3], device=balance.device), force,
                               self._stored(columns) + contact.energy(columns))
        work, most = _work(force, way[columns]), (force.norm(dim=2) * way[columns].norm(dim=2)).sum(dim=1)
        inward, none = work > 0.5 * most, torch.full_like(work, -float("inf"))
        balance.least[columns] = none if contact.has_friction else torch.where(inward, state["potential"], none)
        straight = torch.as_tensor((pose[..., :3, :3] == before[..., :3, :3]).all(axis=(1, 2, 3)),
                                   device=balance.device)  # the moments do no work
        stored = self._stored(columns)
        lost = SNAP * (stored - self._rest[columns]).clamp(min=0.0) + _ROUNDING * state["energy"]
        kept = torch.where(inward & straight[columns], stored - lost, none)
        # without friction every equilibrium of a step inward has more energy than those before it
        self._kept[columns] = kept if contact.has_friction else torch.maximum(kept, self._kept[columns])
        self._work[columns], self._push[columns], self._way = work, force.norm(dim=2).sum(dim=1), way

    def repeats(self, columns: torch.Tensor, pose: np.ndarray) -> np.ndarray:
        """Note the crushed equilibria of ``columns`` (k,) at ``pose`` (B, K, 4, 4), and say which were found there
        before in this step (k,) bool: the object is crushed there, and shorter steps do not change that."""
        balance, host = self._balance, columns.cpu().numpy()
        out = np.zeros(len(host), bool)
        for k in np.flatnonzero(balance.reason[host] == Reason.CRUSHED):
            touch, here = int(host[k]), pose[host[k]].tobytes()
            least = float(wp.to_torch(balance.elasticity.least_det)[touch])
            known = self._crushed.get(touch)
            out[k] = known is not None and known[0] == here and abs(known[1] - least) <= _SAME * least
            self._crushed[touch] = here, least
        return out

    def lift(self, columns: torch.Tensor) -> None:
        """Let ``columns`` (k,) go where they will."""
        self._balance.least[columns] = -float("inf")

    def mark(self, columns: torch.Tensor, pose: np.ndarray, *, last: bool) -> None:
        """Mark equilibria of ``columns`` (k,) at ``pose`` (B, K, 4, 4) that miss energy.

        A step that is not the ``last`` resort is made again in shorter ones if it is doubtful only: without friction
        it has stored less than a smooth force between its ends would have, by more than that estimate may be wrong. A
        long step may end in another equilibrium than short ones, where the surface has slid around an edge, say. Where
        short ones have found the same, there is no doubt any more.

        The bodies have done the work of their force along the step, at the least that of the smaller of the forces at
        its ends. The object stores it, or friction has taken it up: the limits times the ways of slip, at the larger
        push of both ends. Where both are less, the rest has become motion: the object has snapped, as a column does
        that buckles. Where it comes to rest depends on that motion, which this solver does not know. In shorter steps
        an object on its way loses nothing, and one that snaps as much.
        """
        balance, contact = self._balance, self._balance.contact
        if self._way is None:
            return
        force = contact.on_bodies(columns)
        work = torch.minimum(_work(force, self._way[columns]), self._work[columns]).clamp(min=0.0)
        push = force.norm(dim=2).sum(dim=1)
        taken = contact.energy(columns) * (self._push[columns] / push.clamp(min=1e-300)).clamp(min=1.0)
        stored = self._stored(columns)
        lacks = stored + taken < self._kept[columns] + work
        if not last and not contact.has_friction:
            doubtful = self._kept[columns].isfinite() & self._smooth.lacks(
                columns, self._way[columns], force, stored + contact.energy(columns), self._rest[columns])
            lacks |= doubtful & ~self._known(columns, pose, stored, doubtful)
        missing = lacks.cpu().numpy()
        host = columns.cpu().numpy()
        balance.reason[host[missing & (balance.reason[host] == Reason.NONE)]] = Reason.SNAPPED

    def _known(self, columns: torch.Tensor, pose: np.ndarray, stored: torch.Tensor,
               doubtful: torch.Tensor) -> torch.Tensor:
        """Which of the equilibria of ``columns`` (k,), with energies ``stored`` (k,) [J], were found before at ``pose``
        (B, K, 4, 4) in this step (k,) bool. The ``doubtful`` ones (k,) are noted."""
        out = torch.zeros_like(doubtful)
        for k in doubtful.nonzero()[:, 0].tolist():
            touch, energy = int(columns[k]), float(stored[k])
            here = touch, pose[touch].tobytes()
            known = self._doubtful.get(here)
            out[k] = known is not None and abs(known - energy) <= _SAME_ENERGY * abs(energy - float(self._rest[touch]))
            self._doubtful[here] = energy
        return out

    def _stored(self, columns: torch.Tensor) -> torch.Tensor:
        """Energy of object, weight and springs in the states that were evaluated last (k,) [J]."""
        balance = self._balance
        energy = wp.to_torch(balance.elasticity.energy)[columns]
        return energy + balance.contact.carried(columns) - (balance.load * balance.u[:, columns]).sum(dim=0)


class _SmoothForce:
    """What a step stores if the force on the bodies is a parabola through its ends and the equilibrium before it."""

    _older: tuple[torch.Tensor, torch.Tensor] | None = None
    """Places (B, K, 3) [m] of the equilibria before those that the steps begin at, and forces (B, K, 3) [N] there."""
    _now: tuple[torch.Tensor, torch.Tensor]
    """Those of the equilibria that the steps begin at."""
    _stored: torch.Tensor
    """Energy that the steps begin with (B,) [J]."""

    def begin(self, columns: torch.Tensor, place: torch.Tensor, force: torch.Tensor, stored: torch.Tensor) -> None:
        """Begin steps of ``columns`` (k,) at equilibria that have ``stored`` (k,) [J], of bodies at ``place`` (B, K, 3)
        [m] with ``force`` on them (k, K, 3) [N]."""
        if self._older is None:
            none = torch.full_like(place, float("nan"))
            self._older, self._now, self._stored = (none, none), (none, none), none[:, 0, 0].clone()
        fresh = (self._now[0][columns] != place[columns]).flatten(1).any(dim=1)[:, None, None]
        self._older = tuple(old.index_copy(0, columns, torch.where(fresh, now[columns], old[columns]))
                            for old, now in zip(self._older, self._now, strict=True))
        self._now = (self._now[0].index_copy(0, columns, place[columns]), self._now[1].index_copy(0, columns, force))
        self._stored[columns] = stored

    def lacks(self, columns: torch.Tensor, way: torch.Tensor, force: torch.Tensor, stored: torch.Tensor,
              rest: torch.Tensor) -> torch.Tensor:
        """Whether steps of ``columns`` end with too little energy (k,) bool.

        Args:
            columns: touches (k,).
            way: of the bodies in the steps (k, K, 3) [m].
            force: on the bodies at the ends (k, K, 3) [N].
            stored: at the ends (k,) [J].
            rest: stored before anything was touched (k,) [J].
        """
        assert self._older is not None
        back = self._now[0][columns] - self._older[0][columns]
        along = (way * back).sum(dim=(1, 2)) / (way * way).sum(dim=(1, 2)).clamp(min=1e-300)
        ends, starts, before = (_work(f, way) for f in (force, self._now[1][columns], self._older[1][columns]))
        # integral of a parabola: the trapezoid's without a third of its bend, which is also the error that is granted
        bend = ((ends - starts) - (starts - before) / along) / (1.0 + along) / 6.0
        straight = (along > 0.0) & ((along[:, None, None] * way - back).norm(dim=(1, 2)) < 0.1 * back.norm(dim=(1, 2)))
        due = 0.5 * (starts + ends) - bend
        total = self._stored[columns] - rest + due
        return straight & (stored - self._stored[columns] < due - bend.abs() - _DOUBTFUL * total)


def _work(force: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
    """Work of bodies on the object (k,) [J]: ``force`` on them (k, K, 3) [N], ``way`` (k, K, 3) [m]."""
    return -(force * way).sum(dim=(1, 2))
