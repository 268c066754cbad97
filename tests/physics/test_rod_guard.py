"""Guarded touches of rods: before the force limit the arm slows down, turns back and keeps its number of frames."""

from __future__ import annotations

import numpy as np
import pytest
from stems import crossing, stem

from vsfsim.core.shape import Capsule
from vsfsim.physics.rods.model import RodError, build
from vsfsim.physics.rods.solver import Ended, RodFrames, RodOptions, RodSolver
from vsfsim.physics.solve.frames import Reason

HOLD, OUT, LIMIT = 3, 15, 40.0
POSES = crossing(np.linspace(0.0, 0.06, 31), height=0.15, start=-0.07)
PLAN = np.concatenate([np.zeros(2), np.arange(1.0, 31.0), np.full(HOLD, 30.0),
                       np.rint(np.linspace(30, 0, OUT + 1))[1:]])


def solver(*stiffness: float, device: str = "cpu", **options: object) -> RodSolver:
    models = [build(stem(10, radius=0.01, young_modulus=e)) for e in stiffness]
    return RodSolver(models, [Capsule(0.03, 0.2)], device=device,
                     options=RodOptions(**{"force_limit": LIMIT, "guarded": True, "hold": HOLD, "out": OUT,
                                           **options}))  # type: ignore[arg-type]


def push(solver: RodSolver) -> RodFrames:
    n = len(solver.models)
    return solver.run(np.arange(n), np.repeat(POSES, n, axis=1), plan=np.tile(PLAN, (n, 1)),
                      inward=np.full(n, len(PLAN) - OUT), friction=0.4)


@pytest.fixture(scope="module")
def guarded(device):
    """A stem that gives way and one as stiff as a pole, which takes 70 N a frame."""
    return push(solver(1e6, 5e9, device=device))


def test_a_guarded_touch_keeps_its_frames_and_its_limit(guarded):
    force = np.linalg.norm(guarded.force[:, :, 0], axis=-1)
    assert ((guarded.frames == len(PLAN)).all() and (guarded.ended == Ended.WHOLE).all() and guarded.converged.all()
            and force.max() <= LIMIT)
    assert (guarded.where[:, 0] == PLAN).all() and force[:, 0].max() > 0.0, "the soft stem stays below the limit"
    where = guarded.where[:, 1]
    top = where.max()
    first = int(np.argmax(force[:, 1] > 0.0))
    turn = int(np.argmax(where == top))
    assert top < 30.0 and force[turn, 1] > 0.75 * LIMIT, "it creeps up to the limit"
    assert (np.diff(where[:turn + 1]) >= 0.0).all() and (where[turn:turn + 1 + HOLD] == top).all()
    back = np.diff(where[turn + HOLD:])
    # the way back is spread evenly over all frames that are left, and ends where nothing had touched yet
    assert len(back) > OUT and back == pytest.approx(np.full(len(back), back[0]))
    assert where[-1] == pytest.approx(where[first - 1], abs=1e-12)
    assert force[-1, 1] < 1e-9  # at pose 15 the capsule and the stem meet to the last bit
    assert (force[first:-1, 1] > 0.0).all() and (force[:, 1] > 0.0).sum() > 20


def test_what_is_creeped_up_to_is_the_same_equilibrium(guarded, device):
    """Frictionless and elastic: the force at a place between two poses is that of an unguarded touch which goes there
    in steps of its own."""
    force = push(solver(5e9, device=device)).force[:, 0, 0]  # with friction; the same way in
    where = guarded.where[:, 1]
    assert (force == guarded.force[:, 1, 0]).all()
    at = int(np.argmax(where))
    steps = np.concatenate([np.arange(int(where[at]) + 1.0), where[at:at + 1]])
    alone = solver(5e9, device=device, guarded=False, force_limit=1e9).run(np.zeros(1, int), POSES, plan=steps[None],
                                                                           friction=0.4)
    # stuck at another place by a part of a step: a hundredth of the force
    assert np.linalg.norm(alone.force[-1, 0, 0]) == pytest.approx(np.linalg.norm(force[at]), rel=0.02)


def test_what_cannot_be_planned_is_refused(device):
    with pytest.raises(RodError, match="numbers of the 31 poses"):
        solver(1e6, device=device).run(np.zeros(1, int), POSES, plan=PLAN[None] + 1.0)


def hooked(device: str, **options: object) -> RodFrames:
    """The arm goes away from a stem, and on its way back, half a millimetre a frame, past its start into it."""
    away = crossing(np.linspace(0.03, 0.1, 36), height=0.15, start=0.0)
    plan = np.concatenate([np.arange(12.0, 36.0), np.linspace(35.0, 0.0, 141)[1:]])
    return solver(1e9, device=device, out=140, **options).run(np.zeros(1, int), away, plan=plan[None],
                                                              inward=np.array([24]), friction=0.4)


def test_an_arm_that_hooks_something_on_its_way_back_comes_to_a_protective_stop(device):
    """At 1.25 of the limit: there the touch ends, and what it has is what an arm without a limit measures up to
    there."""
    whole, frames = hooked(device, force_limit=1e9), hooked(device)
    force = np.linalg.norm(whole.force[:, 0, 0], axis=-1)
    assert (whole.frames[0] == len(force) and whole.ended[0] == Ended.WHOLE and whole.converged.all()
            and force.max() > 1.5 * LIMIT)
    n = int(frames.frames[0])
    assert n == int(np.argmax(force > 1.25 * LIMIT)) and frames.ended[0] == Ended.FORCE
    assert frames.converged[:n].all() and not frames.converged[n:].any()
    assert np.array_equal(frames.force[:n], whole.force[:n]) and np.isnan(frames.force[n:]).all()
    assert (force[:n] > LIMIT).sum() >= 2, "past the limit, which is one of the way in, and under the stop it goes on"


def test_a_touch_ends_when_its_patience_does(device):
    frames = push(solver(5e9, device=device, patience=20))
    assert frames.ended[0] == Ended.PATIENCE
    assert (3 < frames.frames[0] < len(PLAN) and 20 < frames.iterations.sum() < 60
            and np.isnan(frames.force[frames.frames[0]:]).all())


def test_where_no_frame_finds_an_equilibrium_the_arm_turns_back(device):
    """No room for contacts: every frame that meets the stem fails; after five the arm is where nothing touched, and
    stays out."""
    frames = push(solver(1e6, device=device, room=1, force_limit=1e9))
    bad = np.flatnonzero(~frames.converged[:, 0])
    assert frames.frames[0] == len(PLAN) and len(bad) >= 5 and (np.diff(bad[:5]) == 1).all()
    assert (frames.reason[bad, 0] == Reason.PATCH).any()
    assert frames.where[bad[4] + 1, 0] == frames.where[bad[0] - 1, 0] and np.isfinite(frames.force).all()
