"""What a user may rely on from the solver: retracing, batches, marks, limits, audit."""

import dataclasses
import itertools
import time

import numpy as np
import pytest
from frame_checks import from_above, numbers_stand_for_equilibria

from vsfsim.core.shape import Cylinder, Plane, Sphere
from vsfsim.physics.contact import sdf
from vsfsim.physics.solve.frames import Frames, Reason, SolverOptions
from vsfsim.physics.solve.touches import Solver

SIZE = (0.06, 0.06, 0.03)
PROBE = Sphere(0.015)
TOP = SIZE[2] + 0.015  # the probe's centre at first contact [m]
DEPTHS = np.array([0.001, 0.002, 0.003, 0.004])


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, 0.015)


def down(line, depths, *, x=0.0, y=0.0):
    return line([[x, y, TOP - d] for d in depths], PROBE)


def same(a: Frames, b: Frames):
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=True)
               for f in dataclasses.fields(Frames)
               if f.name != "seconds")


@pytest.fixture(scope="module")
def press(model, line, device):
    return Solver(model, PROBE, device=device).run(down(line, [*DEPTHS, *DEPTHS[-2::-1]]))


def test_audit_of_converged_frames(press, model):
    assert press.converged.all()
    assert (press.residual <= SolverOptions().tolerance).all()
    assert press.force_balance.max() <= 1e-3
    assert press.penetration.max() < 0.01 * model.element_size
    assert (press.min_det_f > 0.0).all()
    assert press.force[0, 0, 2] > 0.0 and (np.diff(press.force[:4, 0, 2]) > 0.0).all()
    assert press.force[:, 0] == pytest.approx(press.reaction[:, 0], abs=1e-3 * press.force[3, 0, 2])


def test_energy_is_the_work_of_the_force(model, line, device):
    """Elastic energy against the integral of the measured force over depth: a law between two outputs that are computed
    apart."""
    depth = np.linspace(0.0, 0.004, 33)[1:]
    frames = Solver(model, PROBE, device=device).run(down(line, depth))
    assert frames.converged.all()
    force = np.concatenate([[0.0], frames.force[:, 0, 2]])
    work = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff([0.0, *depth]))])
    # trapezium rule on 32 steps of a curve ~ d^1.5: 0.1 %; the penalty keeps penetration / depth = 0.2 %
    assert frames.energy[-1, 0] == pytest.approx(work[-1], rel=0.005)
    assert frames.energy[15, 0] == pytest.approx(work[16], rel=0.01)


def test_unloading_retraces_loading(press, model, line, device):
    # at the very same poses the equilibria are the same ones
    assert np.array_equal(press.force[4:], press.force[2::-1])
    # at other depths on the way back: against a fresh press to those depths; no friction, so nothing may be lost
    between = np.array([0.0035, 0.0025, 0.0015])
    back = Solver(model, PROBE, device=device).run(down(line, [*DEPTHS, *between])).force[4:, 0, 2]
    free = down(line, [-0.05])[0]
    fresh = [Solver(model, PROBE, device=device).run(down(line, [d]), start=free).force[0, 0, 2] for d in between]
    assert back == pytest.approx(fresh, rel=1e-3), "both are equilibria to 1e-4"


def test_a_batch_gives_what_its_touches_give_alone(model, line, device):
    places = [(0.0, 0.0), (0.012, -0.004), (0.3, 0.0), (-0.02, 0.02)]
    poses = np.concatenate([down(line, DEPTHS[:3], x=x, y=y) for x, y in places], axis=1)
    solver = Solver(model, PROBE, device=device)
    together = solver.run(poses)
    assert together.converged.all()
    for b in range(len(places)):
        alone = Solver(model, PROBE, device=device).run(poses[:, b:b + 1])
        # both within the tolerance of 1e-4 of the equilibrium
        assert alone.force[:, 0] == pytest.approx(together.force[:, b],
                                                  abs=3e-4 * max(np.abs(alone.force).max(), 1e-12))
    # run to run, on this solver and on a new one: bit for bit
    assert same(together, solver.run(poses))
    assert same(together, Solver(model, PROBE, device=device).run(poses))
    # the third one meets nothing
    assert not together.force[:, 2].any() and not together.penetration[:, 2].any() and not together.energy[:, 2].any()


@pytest.mark.parametrize("linear", [False, True])
def test_a_touch_that_meets_nothing_is_converged_and_zero(model, line, device, linear):
    frames = Solver(model, PROBE, device=device, linear=linear).run(line(np.full((3, 3), 1.0), PROBE))
    assert frames.converged.all()
    for name in ("force", "reaction", "penetration", "energy", "residual", "force_balance"):
        assert not np.any(getattr(frames, name)), name
    assert (frames.min_det_f == 1.0).all()


@pytest.mark.parametrize("linear", [False, True])
def test_weight_alone_is_carried_by_the_supports(block, line, device, linear):
    model = block(SIZE, 0.015, density=1000.0, gravity=(0.0, 0.0, -9.81))
    frames = Solver(model, PROBE, device=device, linear=linear).run(line(np.full((2, 3), 1.0), PROBE))
    assert frames.converged.all() and not frames.force.any()
    # force on the supports' side: up, by the whole weight, to the solver's tolerance
    assert frames.reaction[:, 0] == pytest.approx(np.tile([0.0, 0.0, 9.81 * 1000.0 * np.prod(SIZE)], (2, 1)), rel=1e-3,
                                                  abs=1e-3)


def test_an_impossible_limit_marks_frames_and_stays_finite(model, line, device):
    limited = SolverOptions(tolerance=1e-12, newton=1, halvings=0)
    frames = Solver(model, PROBE, device=device, options=limited).run(down(line, [0.005, 0.01]),
                                                                      start=down(line, [-0.05])[0])
    assert not frames.converged.any()
    assert (frames.residual > 1e-12).all() and (frames.iterations <= 4).all()
    numbers_stand_for_equilibria(frames)


def test_time_limit_is_honoured(model, line, device):
    """Without any time no frame takes an iteration; each is marked with the reason."""
    solver = Solver(model, PROBE, device=device, options=SolverOptions(tolerance=1e-14, seconds=0.0))
    frames = solver.run(down(line, [0.005, 0.01, 0.012]), start=down(line, [-0.05])[0])
    assert (frames.reason == Reason.TIME).all() and not frames.converged.any() and not frames.iterations.any()
    numbers_stand_for_equilibria(frames)


@pytest.mark.parametrize("linear", [False, True])
def test_marks_do_not_depend_on_what_else_the_machine_does(model, line, device, monkeypatch, linear):
    """Every look at the wall clock is an hour later, as on a busy machine; the processor's clock stands still."""
    hours = itertools.count(0.0, 3600.0)
    with monkeypatch.context() as busy:
        busy.setattr(time, "perf_counter", lambda: next(hours))
        busy.setattr(time, "process_time", lambda: 0.0)
        frames = Solver(model, PROBE, device=device, linear=linear).run(down(line, [0.002, 0.004]))
    assert frames.converged.all() and frames.seconds.min() >= 3600.0
    assert np.array_equal(frames.force, Solver(model, PROBE, device=device, linear=linear).run(
        down(line, [0.002, 0.004])).force)


@pytest.mark.parametrize(("probe", "height", "depths"), [
    (Plane(), 0.0, [1e-5, 3e-5]), (Cylinder(0.012, 0.01), 0.005, [1e-5, 3e-5]), (PROBE, 0.015, [4e-4, 6e-4]),
], ids=["plane", "cylinder", "sphere"])
def test_linear_tier_is_fem_at_tiny_depth(model, line, device, probe, height, depths):
    poses = line([[0.0, 0.0, SIZE[2] + height - d] for d in depths], probe)
    nonlinear = Solver(model, probe, device=device).run(poses)
    linear = Solver(model, probe, device=device, linear=True, options=SolverOptions(tolerance=1e-6)).run(poses)
    assert linear.converged.all() and nonlinear.converged.all()
    assert (nonlinear.force[:, 0, 2] > 0.0).all(), "a depth at which no Gauss point is met would show nothing"
    # strains are under depth / contact radius, 3e-3 for the flat ones and 2e-2 or so under the sphere
    assert linear.force[:, 0, 2] == pytest.approx(nonlinear.force[:, 0, 2], rel=0.02)
    assert linear.force_balance.max() <= 1e-3


def test_a_patch_grows_when_surface_comes_to_the_probe(block, line, device):
    """A ball rises from below against a plate that sags by its weight: it meets it where, at rest, it would never have
    been in reach."""
    size = (0.08, 0.04, 0.006)
    model = block(size, 0.01, young_modulus=1e6, poisson_ratio=0.3, density=1000.0, gravity=(0.0, 0.0, -9.81),
                  fixed=(-0.041, -1, -1, -0.0399, 1, 1))
    ball = Sphere(0.01)
    solver = Solver(model, ball, device=device, linear=True)
    free = solver.run(line([[0.03, 0.0, -1.0]], ball), keep=True)
    under = np.argmin(np.linalg.norm(model.mesh.points - [0.03, 0.0, 0.0], axis=1))
    sag = -solver.history[0][3 * under + 2, 0]
    top = -sag + np.array([-0.001, 0.0005, 0.001, 0.002])
    assert top[-1] < -0.003, "the ball must stay well clear of the plate at rest"
    frames = solver.run(line(np.stack([np.full(4, 0.03), np.zeros(4), top - 0.01], axis=1), ball), keep=True)
    assert free.converged.all() and frames.converged.all()
    # the ball holds up part of the weight: the supports are left the rest
    weight = 9.81 * 1000.0 * np.prod(size)
    lifted = -frames.force[:, 0, 2]
    assert lifted[0] == 0.0 and (np.diff(lifted) > 0.01 * weight).all() and lifted[-1] < weight
    assert frames.reaction[:, 0, 2] + lifted == pytest.approx(np.full(4, weight), rel=2e-3)
    # and the plate stays above it, but for the penalty's penetration: nothing has slipped through
    assert frames.penetration.max() < 0.01 * model.element_size
    x = model.mesh.points + solver.history[-1].reshape(-1, 3)
    local = x[model.mesh.surface_nodes()] - [0.03, 0.0, top[-1] - 0.01]
    assert sdf.distance(ball, local).min() > -0.02 * model.element_size


def test_a_run_does_not_depend_on_the_run_before(model, line, device):
    """The same solver serves many touches: a failed frame must not fall back on what an earlier run left behind."""
    hard = SolverOptions(newton=2, halvings=2)
    poses = down(line, [0.006, 0.012])
    fresh = Solver(model, PROBE, device=device, options=hard).run(poses, start=from_above(poses))
    assert (fresh.iterations[0] > 2).any(), "this press was meant to need halved steps"
    used = Solver(model, PROBE, device=device, options=hard)
    used.run(down(line, [0.002, 0.004], x=0.01))
    assert same(fresh, used.run(poses, start=from_above(poses)))
