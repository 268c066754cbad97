"""Beams on a tree against closed forms and a solution of the same rod equations by other means."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import fsolve
from stems import crossing, loaded, plant, stem, touch

from vsfsim.physics.rods.model import SHEAR_ROUND, build


def elastica(tip: float, arm: float, length: float, stiffness: float) -> tuple[float, float, float]:
    """Dead force [N] across the end of a cantilever's first ``arm`` [m] that turns its end by ``tip`` [rad], and where
    the end of all of it then is: sideways, along [m].

    theta'^2 = 2 P / EI (sin tip - sin theta), the first integral of EI theta'' = - P cos theta; theta = tip - u^2 takes
    the root out of the integrals.
    """
    def over(f):
        return quad(lambda u: f(tip - u * u) * 2 * u / np.sqrt(np.sin(tip) - np.sin(tip - u * u))
                    if u > 0 else 2 * f(tip) / np.sqrt(np.cos(tip)), 0, np.sqrt(tip), epsabs=1e-13,
                    epsrel=1e-12)[0]

    whole = over(lambda t: 1.0)
    scale = arm / whole
    rest = length - arm
    return (0.5 * stiffness / scale**2, scale * over(np.sin) + rest * np.sin(tip),
            scale * over(np.cos) + rest * np.cos(tip))


LENGTH, RADIUS, E = 0.4, 0.001, 1e9
EI = E * np.pi * RADIUS**4 / 4


def sagged(segments: int, force: float, node: int, device: str) -> tuple[float, float, float]:
    """Sideways and along [m] of the tip, and its turn [rad]."""
    frames = loaded(stem(segments, length=LENGTH, radius=RADIUS, young_modulus=E),
                    {node: (force, 0.0, 0.0)}, device=device)
    assert frames.converged.all()
    tip = frames.nodes[0, 0, segments]
    return tip[0], tip[2], 2.0 * np.arcsin(np.linalg.norm(frames.turns[0, 0, segments, :3]))


@pytest.mark.parametrize("degrees", [20, 60])
@pytest.mark.parametrize("place", [1.0, 0.5], ids=["tip", "middle"])
def test_a_cantilever_against_the_elastica(degrees, place, device):
    segments = 20  # of 20 mm, as scenes/plant.py cuts wood
    force, side, along = elastica(np.radians(degrees), place * LENGTH, LENGTH, EI)
    x, z, turn = sagged(segments, force, round(place * segments), device)
    # the issue asks for 1 %; the order of convergence says that a fifth of that is what 20 segments leave
    assert abs(x / side - 1) < 0.002 and abs(z / along - 1) < 0.002 and abs(turn / np.radians(degrees) - 1) < 0.002


def test_order_of_convergence_in_the_length_of_segments(device):
    force, side, _ = elastica(np.radians(60), LENGTH, LENGTH, EI)
    error = np.array([abs(sagged(n, force, n, device)[0] / side - 1) for n in (4, 8, 16)])
    order = np.log2(error[:-1] / error[1:])
    assert (order > 1.9).all()  # second order: one point of integration a segment


def test_small_loads_are_exact_at_nodes_whatever_the_slenderness(device):
    """A single segment, from stubby to a hair: Timoshenko's beam, so no locking."""
    for radius in (0.05, 0.005, 1e-4):
        body = stem(1, length=0.2, radius=radius)
        inertia, area, shear = np.pi * radius**4 / 4, np.pi * radius**2, 1e9 / (2 * 1.35)
        soft = 0.2**3 / (3 * 1e9 * inertia) + 0.2 / (SHEAR_ROUND * shear * area)
        assert build(body).compliance[1, 0, 0] == pytest.approx(soft, rel=1e-9)  # an identity, but for rounding
        force = 1e-5 / soft
        # of small strain: (1e-5 / 0.2)^2 and the tolerance
        assert loaded(body, {1: (force, 0.0, 0.0)}, device=device,
                      tolerance=1e-7).nodes[0, 0, 1, 0] == pytest.approx(1e-5, rel=1e-4)


def rod_equations(body, forces):
    """Tips (2, 3) of a Y of three straight pieces under dead tip forces: Simo's and Reissner's equations of a
    continuous rod, integrated and shot at the free ends."""
    joint, tips = body.nodes[1], body.nodes[2:4]
    r, e, nu = body.radius[1:], body.young_modulus[1:], body.poisson_ratio

    def piece(k, place, turn, force, moment, start, stop):
        x = (stop - start) / np.linalg.norm(stop - start)
        y = np.cross(np.eye(3)[np.abs(x).argmin()], x)
        y /= np.linalg.norm(y)
        frame = np.stack([x, y, np.cross(x, y)], axis=1)
        area, inertia, shear = np.pi * r[k]**2, np.pi * r[k]**4 / 4, e[k] / (2 * (1 + nu))
        flex_force = 1.0 / np.array([e[k] * area, SHEAR_ROUND * shear * area, SHEAR_ROUND * shear * area])
        flex_moment = 1.0 / np.array([shear * 2 * inertia, e[k] * inertia, e[k] * inertia])

        def slope(_, state):
            turn_now, moment_now = state[3:12].reshape(3, 3), state[12:]
            axes = turn_now @ frame
            way = axes @ (np.array([1.0, 0, 0]) + flex_force * (axes.T @ force))
            spin = axes @ (flex_moment * (axes.T @ moment_now))
            cross = np.array([[0, -spin[2], spin[1]], [spin[2], 0, -spin[0]], [-spin[1], spin[0], 0]])
            return np.concatenate([way, (cross @ turn_now).ravel(), -np.cross(way, force)])

        end = solve_ivp(slope, (0.0, np.linalg.norm(stop - start)), np.concatenate([place, turn.ravel(), moment]),
                        rtol=1e-9, atol=1e-11).y[:, -1]
        return end[:3], end[3:12].reshape(3, 3), end[12:]

    def shoot(unknown):
        place, turn, moment = piece(0, np.zeros(3), np.eye(3), forces.sum(axis=0), unknown[:3], np.zeros(3), joint)
        own = (unknown[3:], moment - unknown[3:])
        ends = [piece(1 + k, place, turn, forces[k], own[k], joint, tips[k]) for k in (0, 1)]
        return np.concatenate([ends[0][2], ends[1][2]]), np.stack([ends[0][0], ends[1][0]])

    lever = np.cross(tips, forces)
    guess = np.concatenate([lever.sum(axis=0), np.cross(tips[0] - joint, forces[0])])
    found, info, flag, _ = fsolve(lambda u: shoot(u)[0] * 1e3, guess, full_output=True, xtol=1e-10)
    assert flag == 1, info
    return shoot(found)[1]


def test_a_branching_stem_against_the_rod_equations(device):
    """A Y bent out of its plane and twisted, its three pieces of different stiffness."""
    corners = np.array([[0.0, 0, 0], [0.0, 0.0, 0.2], [0.08, 0.0, 0.32], [-0.07, 0.03, 0.30]])
    body = plant(corners, [-1, 0, 1, 1], radius=np.array([1.0, 0.004, 0.0025, 0.003]),
                 young_modulus=np.array([1.0, 8e8, 2e9, 5e8]))
    forces = np.array([[-1.2, 0.9, -0.4], [0.3, 0.8, 0.5]])
    exact = rod_equations(body, forces)
    errors = []
    for cut in (8, 16):
        nodes, parent, radius, modulus = [corners[0]], [-1], [1.0], [1.0]
        last = {0: 0}
        for k in (1, 2, 3):
            at = last[body.parent[k]]
            for step in range(1, cut + 1):
                nodes.append(corners[body.parent[k]] + step / cut * (corners[k] - corners[body.parent[k]]))
                parent.append(at)
                radius.append(body.radius[k])
                modulus.append(body.young_modulus[k])
                at = len(nodes) - 1
            last[k] = at
        fine = plant(np.array(nodes), parent, radius=np.array(radius), young_modulus=np.array(modulus))
        frames = loaded(fine, {last[2]: forces[0], last[3]: forces[1]}, device=device)
        assert frames.converged.all()
        errors.append(np.abs(frames.nodes[0, 0, [last[2], last[3]]] - exact).max())
    moved = np.linalg.norm(exact - corners[2:], axis=1)
    assert moved.min() > 0.05
    assert errors[1] < 0.005 * moved.min() and errors[0] / errors[1] > 3.5  # second order gives 4


def test_the_pot_holds_what_the_arm_pushes(device):
    """Force and moment of capsules, and those of the clamp, about the origin, with friction and two capsules at
    once."""
    nodes = [np.zeros(3)]
    parent = [-1]
    for k in range(1, 13):
        nodes.append(np.array([0.0, 0.0, 0.03 * k]))
        parent.append(k - 1)
    for k in range(1, 7):
        nodes.append(nodes[8] + 0.03 * k * np.array([0.6, 0.0, 0.8]))
        parent.append(8 if k == 1 else len(nodes) - 2)
    body = plant(np.array(nodes), parent, radius=0.003)
    # one pushes, the other stands in the way
    poses = np.concatenate([crossing(np.linspace(0.0, 0.06, 16), height=0.15, start=-0.05),
                            crossing(np.zeros(16), height=0.32, start=0.04)], axis=2)
    frames = touch(body, poses, friction=0.4, radius=0.02, device=device)
    assert frames.converged.all() and (np.linalg.norm(frames.force[-1, 0], axis=1) > 0.05).all()
    place = poses[:, 0, :, :3, 3]
    moment = (frames.moment[:, 0] + np.cross(place, frames.force[:, 0])).sum(axis=1)
    force = frames.force[:, 0].sum(axis=1)
    size = np.abs(frames.force[:, 0]).sum(axis=(1, 2))
    # what touches the capsules pushes with the reaction of the pot: tolerance 1e-4 of the contact forces, over levers
    # under a metre
    assert (np.abs(force - frames.reaction[:, 0]).max(axis=1) <= 2e-4 * np.maximum(size, 1.0)).all()
    assert (np.abs(moment - frames.reaction_moment[:, 0]).max(axis=1) <= 2e-4 * np.maximum(size, 1.0)).all()
