"""The force estimator: its elements against closed forms, its program against its optimality, its answers against
known pushes."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

sys.path.insert(0, str(Path(__file__).parent))
from toy_bubble import bubble, disc, patch

from vsfsim.physics.elements import triangle
from vsfsim.physics.mesh.quadratic import assemble
from vsfsim.sensing.dense_force import METHODS, BubbleCalibration, DenseForceEstimator, EstimatorOptions, ridge, solve
from vsfsim.sensing.membrane_fe import SensorError, in_their_planes, nodal_areas, skin_forces


@pytest.fixture(scope="module")
def toy():
    return bubble(6)


@pytest.fixture(scope="module")
def calibration(toy):
    rim = np.zeros(len(toy.rest), bool)
    rim[toy.rim] = True
    return BubbleCalibration(toy.rest, toy.triangles, rim, 680.0, toy.pressure, reference=toy.flat)


@pytest.fixture(scope="module")
def presses(toy):
    """Known pushes up to 5 N, slanted: positions (T, n, 3), pressures (T,), forces (T, n, 3)."""
    full = patch(toy, (0.012, 0.004), 0.016, 5.0, slant=(0.2, -0.1))
    states, x = [], None
    for share in (0.2, 0.4, 0.7, 1.0):
        x, p = toy.push(share * full, start=x)
        states.append((x, p, share * full))
    return tuple(np.array(part) for part in zip(*states))


# elements


def test_a_uniform_strain_of_the_linear_skin_is_carried_by_the_rim_alone():
    flat, triangles, rim = disc(4)
    points = np.column_stack([flat, np.zeros(len(flat))])
    k = assemble(len(points), (triangle.block(triangles, points, in_their_planes(points, triangles), 700.0),))
    strain = np.array([[0.01, 0.003], [0.003, -0.004]])
    force = (k @ np.column_stack([flat @ strain, np.zeros(len(flat))]).ravel()).reshape(-1, 3)
    inner = np.setdiff1d(np.arange(len(flat)), rim)
    assert np.abs(force[inner]).max() < 1e-11
    # virtual work: sum x_i f_j = A sigma_ij, sigma = D strain of plane stress with nu = 1/2
    stress = 700.0 / 0.75 * (0.5 * strain + 0.5 * np.trace(strain) * np.eye(2))
    area = np.abs(nodal_areas(points, triangles)[:, 2]).sum()
    assert np.einsum("ni,nj->ij", flat, force[:, :2]) / area == pytest.approx(stress, rel=1e-9)
    assert np.abs(force[:, 2]).max() < 1e-12  # a slack flat membrane has no stiffness across itself


def test_a_skin_at_equal_stretch_has_the_tension_of_the_closed_form():
    flat, triangles, _ = disc(3)
    stretch = 1.3
    points = np.column_stack([stretch * flat, np.zeros(len(flat))])
    force = skin_forces(points, triangles, flat[triangles], 600.0)
    # equal stretch: tension mu h (1 - s^-6) per present length, and sum x . f = 2 T A
    area = np.abs(nodal_areas(points, triangles)[:, 2]).sum()
    assert np.sum(points * force) == pytest.approx(2 * 200.0 * (1 - stretch**-6) * area, rel=1e-12)


# program


@pytest.mark.parametrize(("lasso", "smooth", "friction"), [
    (4.0, 3.0, 0.6), (2.0, 0.0, np.inf)])
def test_four_nodes_meet_the_optimality_conditions(lasso, smooth, friction):
    rng = np.random.default_rng(3)
    root = rng.standard_normal((12, 12))
    k = root @ root.T * 20 + 50 * np.eye(12)
    inward = rng.standard_normal((4, 3))
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    c, d, w = rng.standard_normal(12), 1e-2 * rng.standard_normal(12), 4e4
    edges = np.array([[0, 1], [1, 2], [0, 3]])
    neighbours = smooth**-0.5 if smooth else np.inf
    program = EstimatorOptions(w**-0.5, 1.0 / lasso, neighbours, friction, tolerance=1e-8, iterations=100_000)
    found = solve(sparse.csr_matrix(k), c, d, program, inward=inward, edges=edges)
    f = found.force.reshape(4, 3)
    # with y minus the slope of all but the lasso, no z in the cone of a node has y . (z - f) > lasso (|z| - |f|)
    u = np.linalg.solve(k, found.force - c)
    y = -np.linalg.solve(k.T, w * (u - d)).reshape(4, 3)
    for i, j in edges:
        y[i] -= smooth * (f[i] - f[j])
        y[j] -= smooth * (f[j] - f[i])

    def outside(force):
        sink = np.einsum("...i,...i->...", force, inward)
        return -sink if np.isinf(friction) else np.linalg.norm(np.cross(force, inward), axis=-1) - friction * sink

    z = np.abs(f).max() * rng.uniform(0.0, 2.0, (5000, 4, 1)) * rng.standard_normal((5000, 4, 3))
    z[outside(z) > 0.0] = 0.0
    gain = np.einsum("ni,kni->kn", y, z - f) - lasso * (np.linalg.norm(z, axis=2) - np.linalg.norm(f, axis=1))
    assert outside(f).max() < 1e-9 and gain.max() < 1e-4 and found.residual < 1e-8
    # from its own answer there is nothing left to do but to look
    again = solve(sparse.csr_matrix(k), c, d, replace(program, iterations=20), inward=inward, edges=edges,
                  start=found.start)
    assert again.residual < 1e-8 and again.force == pytest.approx(found.force, abs=1e-6)


def test_the_quadratic_program_is_stationary():
    rng = np.random.default_rng(3)
    k, (c, d) = sparse.csr_matrix(rng.standard_normal((12, 12))), rng.standard_normal((2, 12, 2))
    found = ridge(k, c, d, EstimatorOptions(0.5, 3.0**-0.5))
    assert found.force == pytest.approx(k @ found.displacement + c, abs=1e-12) and found.converged.all()
    assert 4.0 * (found.displacement - d) + 3.0 * k.T @ found.force == pytest.approx(np.zeros((12, 2)), abs=1e-10)


# estimates


def test_a_small_push_is_found_by_the_linear_tangent_and_missed_without_tension(toy, calibration):
    # 0.05 N: linear theory holds; `paper`, which has no tension, spreads the force over the dome and loses the patch
    true = patch(toy, (0.012, 0.004), 0.016, 0.05)
    x, p = toy.push(true)
    # exact readings: next to no shrinkage
    options = EstimatorOptions(displacement_std=1e-6, force_scale=1.0)
    found = {m: DenseForceEstimator(calibration, method=m, options=options).estimate(x[None], np.array([p]))
             for m in METHODS}
    error = {m: np.linalg.norm(estimate.force[0] - true) / np.linalg.norm(true) for m, estimate in found.items()}
    assert error["membrane"] < 0.02
    assert min(error["residual"], error["paper"]) > 0.9  # deterministic: 0.98 of the push


def test_more_air_alone_is_no_contact(toy, calibration):
    # the dome inflated by 2 % more pressure, nothing touching: the skin alone balances the air
    grown = replace(toy, pressure=toy.pressure)
    grown.gauge = lambda points: 1.02 * toy.pressure
    grown.gamma = 0.0  # the pressure is given
    x, p = type(toy).push(grown, np.zeros_like(toy.rest))
    assert np.linalg.norm(x - toy.rest, axis=1).max() > 3e-4
    found = DenseForceEstimator(calibration, method="membrane").estimate(x[None], np.array([p]))
    assert np.linalg.norm(found.force, axis=2).max() < 1e-6


def test_noise_alone_is_hardly_a_force_and_a_push_is_found_through_it(toy, calibration, presses):
    position, pressure, true = presses
    rng = np.random.default_rng(5)
    noisy = np.concatenate([np.broadcast_to(toy.rest, (2, *toy.rest.shape)), position])
    noisy = noisy + 5e-5 * rng.standard_normal(noisy.shape)
    p = np.concatenate([np.full(2, toy.pressure), pressure]) + 5.4 * rng.standard_normal(6)
    errors = {}
    for method in METHODS:
        found = DenseForceEstimator(calibration, method=method).estimate(noisy, p)
        assert np.isfinite(found.force).all() and (found.force[:, toy.rim] == 0).all()
        errors[method] = np.sqrt(((found.force[2:] - true) ** 2).sum(axis=2).mean(axis=1))
        if method == "membrane":
            assert found.converged.all()
            # N, where 5.4 Pa over the base alone is 0.04 N
            assert np.linalg.norm(found.force[:2].sum(axis=1), axis=1).max() < 0.3
            inward = -np.einsum("tni,tni->tn", found.force, np.stack([nodal_areas(x, toy.triangles) for x in noisy]))
            assert (inward >= -1e-9).all()  # nothing pulls
    # ours is better than what it is based on, in every frame, and the regularised better than the raw
    assert (errors["membrane"] < 0.7 * errors["paper"]).all()
    assert (errors["paper"] < errors["residual"]).all()


def test_a_touch_of_a_dataset_in_the_world(toy, calibration, presses):
    from vsfsim.bench.mock import mock_view
    from vsfsim.sensing.bubble_touch import estimate_forces, rim_of

    position, pressure, _ = presses
    assert (rim_of(toy.triangles, len(toy.rest)) == calibration.rim).all()
    mock = mock_view(0, split="test", touches=1).touches[0]
    turn, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    turn = turn * np.sign(np.linalg.det(turn))
    frames = len(position)
    pose = np.tile(np.eye(4), (frames, 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = turn, np.arange(3 * frames).reshape(-1, 3) / 10
    converged = np.array([True, False, True, True])
    world = position @ turn.T + pose[:, None, :3, 3]
    world[1] = np.nan
    touch = replace(mock, mount_pose=pose, converged=converged, pressure=pressure, rest_pressure=toy.pressure,
                    node_position=world, node_rest=toy.rest,
                    node_reference=toy.flat, node_triangles=toy.triangles)
    found = estimate_forces(touch, stiffness=680.0)
    local = DenseForceEstimator(calibration, method="membrane").estimate(position[converged], pressure[converged])
    assert found.force[converged] == pytest.approx(local.force @ turn.T, abs=1e-6)
    assert np.isnan(found.force[1]).all() and found.converged.tolist() == [True, False, True, True]
    # nothing converged: nothing is said, and nothing falls over
    for method in METHODS:
        none = estimate_forces(replace(touch, converged=np.zeros(frames, bool)), stiffness=680.0, method=method)
        assert np.isnan(none.force).all() and not none.converged.any()
    with pytest.raises(SensorError, match="no node positions"):
        estimate_forces(mock, stiffness=680.0)


def test_what_it_refuses(calibration, toy):
    with pytest.raises(SensorError, match="membrane"):
        DenseForceEstimator(calibration, method="membran")
    with pytest.raises(SensorError, match="needs the stress-free coordinates"):
        DenseForceEstimator(replace(calibration, reference=None), method="membrane")
    with pytest.raises(SensorError, match="wound the other way"):
        DenseForceEstimator(replace(calibration, reference=toy.flat * [-1, 1]), method="membrane")
    estimator = DenseForceEstimator(calibration)
    with pytest.raises(SensorError, match="not finite"):
        estimator.estimate(np.full((1, *toy.rest.shape), np.nan), np.array([7000.0]))
    with pytest.raises(SensorError, match="membrane: triangle 0 has no area"):
        DenseForceEstimator(calibration, method="membrane").estimate(0 * toy.rest[None], np.array([7000.0]))
