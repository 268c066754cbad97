"""The rod solver: derivatives, contact, friction, release, batches, and cases that are hard."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from stems import crossing, plant, stem, touch

from vsfsim.core.shape import Capsule
from vsfsim.physics.rods.model import RodError, build
from vsfsim.physics.rods.solver import RodOptions, RodSolver
from vsfsim.physics.solve.frames import Reason


def finite(frames) -> bool:
    """No number of a solved frame is NaN or infinite, converged or not."""
    return all(np.isfinite(a[:int(frames.frames.min())]).all()
               for a in (frames.force, frames.moment, frames.reaction, frames.energy, frames.penetration, frames.nodes))


def test_sections_are_those_of_beam_theory():
    body = plant(np.array([[0.0, 0, 0], [0, 0, 0.1], [0.05, 0, 0.1]]), [-1, 0, 1],
                 radius=np.array([1.0, 0.004, 0.0005]), half_width=np.array([0.0, 0.0, 0.02]), young_modulus=2e8,
                 blade_normal=np.array([0.0, 0.0, 1.0]))
    model = build(body)
    shear = 2e8 / 2.7
    assert model.kphi[1] == pytest.approx(np.array([shear * np.pi / 2, 2e8 * np.pi / 4,
                                                    2e8 * np.pi / 4]) * 0.004**4 / 0.1, rel=1e-12)
    # a blade 40 mm wide, 1 mm thick: axis 2 of its frame is the width, so bending about it is the soft one
    assert model.kphi[2] == pytest.approx(np.array([shear / 3 * 0.04 * 0.001**3, 2e8 / 12 * 0.04 * 0.001**3,
                                                    2e8 / 12 * 0.001 * 0.04**3]) / 0.05, rel=1e-12)
    assert np.abs(model.frame[2] - np.stack([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], axis=1)).max() < 1e-12


def test_energy_is_the_work_that_the_arm_does(device):
    """Frictionless: the integral of force over the capsule's way is the elastic energy, which ties forces to the
    potential; and the way back gives the same forces."""
    travel = np.concatenate([np.linspace(0.0, 0.08, 81), np.linspace(0.08, 0.0, 9)[1:]])
    frames = touch(stem(15, length=0.3), crossing(travel, height=0.25, start=-0.035), radius=0.03, device=device,
                   tolerance=1e-7)
    assert frames.converged.all()
    force = -frames.force[:81, 0, 0, 0]
    work = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(travel[:81]))])
    # the trapezium's error at the kink of first contact is half a step's force; the penalty keeps a thousandth
    assert frames.energy[80, 0] == pytest.approx(work[80], rel=5e-3)
    assert frames.force[81:, 0] == pytest.approx(frames.force[70::-10, 0], abs=1e-5 * force.max())
    # released, it is where it was but for rounding
    assert frames.energy[-1, 0] < 1e-20 and np.abs(frames.nodes[-1, 0] - frames.nodes[0, 0]).max() < 1e-14
    assert np.nanmax(frames.penetration) < 0.005 * 0.08


def test_friction_sticks_then_slips_both_ways(device):
    """A level capsule bends a stem by 12 mm and then drags it sideways: the stem goes along while its force sideways is
    under mu times the push, and slips past that."""
    press, mu = np.linspace(0.0, 0.012, 13), 0.5
    drag = np.linspace(0.0, 0.015, 61)[1:]
    poses = crossing(np.concatenate([press, np.full(180, press[-1])]), height=0.2, start=-0.0335)
    poses[13:, 0, 0, 1, 3] += np.concatenate([drag, drag[-1] - 2 * drag, -drag[-1] + drag])
    frames = touch(stem(20, length=0.4, radius=0.0035), poses, radius=0.03, friction=mu, device=device)
    assert frames.converged.all()
    force = frames.force[13:, 0, 0]
    ratio = force[:, 1] / np.hypot(force[:, 0], force[:, 2])
    assert np.abs(ratio).max() < 1.001 * mu  # the cone, to ten times the solver's tolerance
    # what the press has left along the stem stays as the drag begins
    assert force[0, 2] == pytest.approx(frames.force[12, 0, 0, 2], rel=0.1)
    # a round stem is as stiff sideways: it sticks for mu times 12 mm of drag
    at = drag / 0.012
    stick = drag < 0.9 * mu * 0.012
    # the press has left friction along the stem, up to mu, which is part of the push as it is taken here: 1 - cos(atan
    # mu / 2) and the slope of 0.09 rad
    assert ratio[:60][stick] == pytest.approx(-at[stick], rel=0.08)
    slip = drag > 1.1 * mu * 0.012
    assert ratio[:60][slip] == pytest.approx(-mu, rel=1e-3)
    # Dragged back, half a millimetre a frame, it sticks: the force sideways falls with the stem's stiffness, which the
    # first frames of the drag have shown (the stem also rolls, and its friction along rises). It comes to the other
    # limit after twice the way that it stuck on before, and no sooner.
    stiffness = -force[5, 1] / drag[5]
    assert force[60:66, 1] == pytest.approx(force[59, 1] + stiffness * 5e-4 * np.arange(1, 7), abs=0.05 * mu * 0.5)
    assert np.sign(ratio[68]) != np.sign(ratio[78]) and ratio[90:119] == pytest.approx(mu, rel=1e-3)


@pytest.mark.parametrize("step", [0.0005, 0.02])
def test_a_thin_stem_is_never_jumped(step, device):
    """A reading every 0.5 mm or every 20 mm: the stem stays before the capsule until it slips off over its end, and
    then stands up again."""
    travel = np.arange(0.0, 0.30, step)
    frames = touch(stem(15, length=0.3, radius=0.001, young_modulus=5e9), crossing(travel, height=0.2, start=-0.04),
                   radius=0.015, device=device)
    assert finite(frames) and frames.converged.mean() > 0.97
    held = frames.contacts[:, 0] > 0
    let_go = -0.04 + travel[np.flatnonzero(held).max()]
    # the stem cannot slip off before its 0.3 m no longer reach over the capsule at a height of 0.2 m
    assert held.sum() > 3 and let_go > 0.15
    assert not held[-1] and np.abs(frames.nodes[-1, 0] - frames.nodes[0, 0]).max() < 1e-9


def test_a_batch_gives_the_bits_of_touches_alone(device):
    fork = plant(np.array([[0.0, 0, 0], [0, 0, 0.1], [0.05, 0, 0.18], [-0.05, 0, 0.2]]), [-1, 0, 1, 1])
    models = [build(stem(10, length=0.3)), build(fork)]
    which = np.array([0, 1, 1, 0])
    poses = np.concatenate([crossing(np.linspace(0.0, 0.05, 12), height=h, start=-0.05)
                            for h in np.random.default_rng(0).uniform(0.1, 0.2, 4)], axis=1)
    shapes = [Capsule(0.03, 0.1)]
    together = RodSolver(models, shapes, device=device).run(which, poses, friction=0.3)
    for b in range(4):
        alone = RodSolver([models[which[b]]], shapes, device=device,
                          options=RodOptions(share=5)).run(np.zeros(1, int), poses[:, b:b + 1], friction=0.3)
        assert (alone.force[:, 0] == together.force[:, b]).all() and (alone.energy[:, 0] == together.energy[:, b]).all()
    for wrong in ({"friction": -0.1}, {"plan": [[0, 12]] * 4}, {"plan": [[0]]}):
        with pytest.raises(RodError, match="give friction of 0 at least"):
            RodSolver(models, shapes, device=device).run(which, poses, **wrong)


def test_a_touch_ends_before_the_frame_past_the_force_limit(device):
    """A stem as stiff as a pole, which takes 70 N a frame, in and out again."""
    models = [build(stem(10, radius=0.01, young_modulus=5e9))]
    poses = crossing(np.linspace(0.0, 0.06, 31), height=0.15, start=-0.07)
    plan = np.concatenate([np.arange(31), np.arange(30)[::-1]])[None]
    whole, short = (RodSolver(models, [Capsule(0.03, 0.2)], device=device, options=RodOptions(force_limit=limit)).run(
        np.zeros(1, int), poses, plan=plan, friction=0.4) for limit in (np.inf, 500.0))
    force = np.linalg.norm(whole.force[:, 0, 0], axis=-1)
    n = int(short.frames[0])
    assert whole.frames[0] == 61 and whole.converged.all() and force.max() > 500.0
    assert n == int(np.argmax(force > 500.0)) and short.converged[:n].all() and not short.converged[n:].any()
    assert np.array_equal(short.force[:n], whole.force[:n]) and np.isnan(short.force[n:]).all()


def test_a_frame_without_room_for_its_contacts_is_marked(device):
    poses = crossing(np.linspace(0.0, 0.06, 31), height=0.15, start=-0.07)
    frames = touch(stem(10, radius=0.01, young_modulus=1e6), poses, device=device, room=1)
    bad = ~frames.converged[:, 0]
    assert bad.any() and (frames.reason[bad, 0] == Reason.PATCH).any() and finite(frames)


def test_moduli_from_1e4_to_1e11_in_one_plant(device):
    """Segments a hair and an arm thick, seven decades of modulus: frames converge or say why, and nothing is NaN."""
    rng = np.random.default_rng(3)
    nodes, parent = [np.zeros(3)], [-1]
    for k in range(1, 41):
        above = int(rng.integers(max(0, k - 4), k))
        nodes.append(nodes[above] + 0.03 * (np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.5, 3)))
        parent.append(above)
    body = plant(np.array(nodes), parent, radius=10.0 ** rng.uniform(-3, np.log10(0.03), 41),
                 young_modulus=10.0 ** rng.uniform(4, 11, 41))
    poses = np.concatenate([crossing(np.linspace(0.0, 0.2, 41), height=h, start=-0.15) for h in (0.03, 0.08, 0.13)],
                           axis=1)
    solver = RodSolver([build(body)], [Capsule(0.03, 0.2)], device=device)
    frames = solver.run(np.zeros(3, int), poses, friction=0.4, keep_nodes=True)
    assert finite(frames)
    # one touch drives the link into segments of 1e11 Pa as thick as an arm, which do not move: the force is 1e8 N, and
    # frames with points deeper than 1 mm are marked
    wrong_side = frames.reason == Reason.WRONG_SIDE
    assert ((frames.reason > 0) == ~frames.converged).all()
    # measured: 0.764 of the frames converge, and all others are marked as on the wrong side
    assert (frames.converged | wrong_side).mean() > 0.97 and frames.converged.mean() > 0.73
    assert frames.penetration[frames.converged].max() <= 0.001
    assert np.linalg.norm(frames.force[wrong_side], axis=-1).max() > 1e6


def test_a_leaf_pinched_between_two_links(device):
    """Two capsules close on a blade until they would crush it: what is inside is reported, nothing is NaN, and what
    pushes one way pushes back the other."""
    nodes = np.zeros((7, 3))
    nodes[:, 0] = [0.0, 0.02, 0.05, 0.08, 0.11, 0.14, 0.17]
    nodes[:, 2] = 0.2
    nodes[0] = [0.0, 0.0, 0.15]
    half = np.array([0.0, 0.0, 0.01, 0.02, 0.02, 0.015, 0.008])
    body = plant(nodes, np.arange(-1, 6), radius=np.where(half > 0, 0.0003, 0.0015), half_width=half, young_modulus=2e7,
                 blade_normal=np.array([0.0, 0.0, 1.0]))
    gap = np.concatenate([np.linspace(0.04, 0.0, 41), np.linspace(0.0, 0.04, 41)[1:]])
    pair = [crossing(np.zeros(81), height=0.2, start=0.11) for _ in range(2)]
    for sign, poses in zip((1, -1), pair, strict=True):
        poses[:, 0, 0, 2, 3] = 0.2 + sign * (0.02 + 0.5 * gap - 0.0002)
    frames = touch(body, np.concatenate(pair, axis=2), radius=0.02, device=device, friction=0.4)
    assert finite(frames) and frames.converged.mean() > 0.95
    closed = frames.force[40, 0, :, 2]
    assert closed[0] > 0.0 > closed[1]
    assert abs(closed.sum()) < 0.02 * np.abs(closed).sum()
    assert frames.penetration[40, 0] < 0.001


def test_a_leaf_that_a_link_goes_through_is_marked_until_it_is_free(device):
    """A thin link that stands in the middle of a blade and is drawn out along its axis: in-plane the blade is stiff, so
    pushes from all sides balance with the link right through it. Such an equilibrium is no reading."""
    nodes = np.zeros((6, 3))
    nodes[:, 0], nodes[:, 2] = [0.0, 0.02, 0.06, 0.10, 0.14, 0.18], 0.2
    half = np.array([0.0, 0.0, 0.03, 0.03, 0.03, 0.03])
    body = plant(nodes, np.arange(-1, 5), radius=np.where(half > 0, 0.0003, 0.002), half_width=half, young_modulus=2e7,
                 blade_normal=np.array([0.0, 0.0, 1.0]))
    poses = np.tile(np.eye(4), (21, 1, 1, 1, 1))
    poses[:, 0, 0, :3, 3] = [0.1, 0.0, 0.2]
    poses[:, 0, 0, 2, 3] += np.linspace(0.0, 0.1, 21)
    frames = touch(body, poses, radius=0.013, length=0.08, device=device)
    inside = frames.penetration[:, 0] > 0.001
    # the capsule's round end comes past the blade after 53 mm: until then an equilibrium, found and marked; a last
    # touch of its rim is marked too, as the sides may have changed
    assert finite(frames) and inside[:9].all()
    assert (frames.residual[:9, 0] < 1e-4).all() and (frames.reason[:9, 0] == Reason.WRONG_SIDE).all()
    free = frames.contacts[:, 0] == 0
    assert (frames.converged[:, 0] == free).all() and free[11:].all()
    assert np.abs(frames.nodes[-1, 0] - body.nodes).max() < 1e-12


def test_a_heavy_stem_sags(device):
    """Small strain: the tip of a level cantilever under its own weight goes down by w L^4 / (8 EI)."""
    nodes = np.zeros((21, 3))
    nodes[:, 0], nodes[:, 2] = np.linspace(0.0, 0.2, 21), 0.1
    body = dataclasses.replace(plant(nodes, np.arange(-1, 20), radius=0.002, young_modulus=5e9),
                               density=np.full(21, 800.0))
    far = crossing(np.zeros(1), height=1.0, start=1.0)
    frames = touch(build(body, gravity=(0.0, 0.0, -9.81)), far, device=device, force_floor=1e-9)
    assert frames.converged.all()
    down = 800.0 * 9.81 * np.pi * 0.002**2 * 0.2**4 / (8 * 5e9 * np.pi * 0.002**4 / 4)
    # lumped at nodes: second order in 1/20
    assert 0.1 - frames.nodes[0, 0, -1, 2] == pytest.approx(down, rel=0.01)
    # half a segment stands on the clamp
    assert frames.reaction[0, 0, 2] == pytest.approx(800.0 * 9.81 * np.pi * 0.002**2 * 0.2 * 39 / 40, rel=1e-3)


def test_what_cannot_be_solved_is_refused():
    with pytest.raises(RodError, match=r"segment 1 .* 8 m wide"):
        build(plant(np.array([[0.0, 0, 0], [0, 0, 0.1]]), [-1, 0], half_width=4.0,
                    blade_normal=np.array([1.0, 0.0, 0.0])))


@wp.kernel(enable_backward=False)
def _derivatives(place: wp.array(dtype=wp.vec3d), turn: wp.array(dtype=wp.quatd), kd: wp.vec3d, kphi: wp.vec3d,
                 wire: wp.vec2d, left: wp.vec3d, energy_out: wp.array(dtype=wp.float64),
                 first_out: wp.array2d(dtype=wp.vec3d), second_out: wp.array2d(dtype=wp.spatial_matrixd)):
    b = wp.tid()
    s = segment.strain(place[2 * b], turn[2 * b], place[2 * b + 1], turn[2 * b + 1], turn[2 * place.shape[0] // 2],
                       wp.float64(0.1))
    energy_out[b] = segment.energy(s, kd, kphi, wire, left)
    mu = segment.moment(s, kphi, wire, left)
    f, mc, mp = segment.gradient(s, kd, mu)
    first_out[b, 0] = f
    first_out[b, 1] = mc
    first_out[b, 2] = mp
    child, parent, mixed = segment.hessian(s, kd, mu, segment.moment_tangent(s, kphi, wire, left), wp.float64(1.0))
    second_out[b, 0] = parent
    second_out[b, 1] = mixed
    second_out[b, 2] = child


from vsfsim.physics.rods.kernels import segment  # noqa: E402  compiled at the launch


@pytest.mark.parametrize(("bend", "wire"), [
    (0.01, (0.0, 0.0)), (0.4, (0.0, 0.0)), (2.0, (0.0, 0.0)),
    (0.01, (0.02, 1e-3)), (0.4, (0.02, 1e-3)), (0.4, (0.02, 0.1)), (2.0, (0.02, 1e-3))])
def test_the_gradient_and_the_second_derivative_are_those_of_the_energy(bend, wire, device):
    """Along random paths of constant spins, by central differences, from nearly straight to two radians in one
    segment; without a core, and with one that yields, or does not, with a plastic bending left from before."""
    rng = np.random.default_rng(int(10 * bend))
    kd, kphi = np.array([40.0, 7.0, 5.0]), np.array([0.02, 0.05, 0.03])
    frame, turn_p, axis = rng.normal(size=(3, 3))
    turn_p = Rotation.from_rotvec(turn_p)
    turn_c = Rotation.from_rotvec(bend * axis / np.linalg.norm(axis)) * turn_p
    way = rng.normal(size=3) * 0.06
    direction = rng.normal(size=12) * np.repeat([0.05, 1.0, 0.05, 1.0], 3)
    steps = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) * 1e-3
    place, turn = [], []
    for t in steps:
        place += [t * direction[:3], way + t * direction[6:9]]
        turn += [(Rotation.from_rotvec(t * direction[3:6]) * turn_p).as_quat(),
                 (Rotation.from_rotvec(t * direction[9:]) * turn_c).as_quat()]
    turn.append(Rotation.from_rotvec(frame).as_quat())
    energies = wp.zeros(5, dtype=wp.float64, device=device)
    first = wp.zeros((5, 3), dtype=wp.vec3d, device=device)
    blocks = wp.zeros((5, 3), dtype=wp.spatial_matrixd, device=device)
    wp.launch(_derivatives, dim=5, inputs=[wp.array(np.array(place), dtype=wp.vec3d, device=device),
                                           wp.array(np.array(turn), dtype=wp.quatd, device=device), wp.vec3d(*kd),
                                           wp.vec3d(*kphi), wp.vec2d(*wire), wp.vec3d(0.0, 0.02, -0.01)],
              outputs=[energies, first, blocks], device=device)
    e, (f, mc, mp), h = energies.numpy(), first.numpy()[2], blocks.numpy()[2]
    slope = np.concatenate([-f, mp, f, mc]) @ direction
    full = np.block([[h[0], h[1].T], [h[1], h[2]]])
    # five points: the error is of fourth order in the step, and rounding of the energy over its square
    assert slope == pytest.approx((8 * (e[3] - e[1]) - (e[4] - e[0])) / (12 * 1e-3), rel=1e-7)
    assert direction @ full @ direction == pytest.approx((16 * (e[3] + e[1]) - (e[4] + e[0]) - 30 * e[2]) / (12 * 1e-6),
                                                         rel=1e-5)
    assert np.abs(full - full.T).max() < 1e-12 * np.abs(full).max()
