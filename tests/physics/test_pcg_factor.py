"""Conjugate gradients by columns, the rest-state factor, and the preconditioner made of it."""

import numpy as np
import pytest
import warp as wp

from vsfsim.core.shape import Sphere
from vsfsim.physics import pcg
from vsfsim.physics.solver import Solver, SolverOptions
from vsfsim.physics.touching import Touching


def by_numpy(matrix, device):
    return lambda x: wp.array(np.ascontiguousarray(np.einsum("kij,jk->ik", matrix, x.numpy())), dtype=wp.float64, device=device)


@pytest.fixture(scope="module")
def systems():
    """Five symmetric positive definite matrices (5, 60, 60) of condition 1 to 1e4, and right-hand sides (60, 5)."""
    rng = np.random.default_rng(0)
    out = []
    for condition in (1.0, 10.0, 1e2, 1e3, 1e4):
        q = np.linalg.qr(rng.standard_normal((60, 60)))[0]
        out.append(q * np.geomspace(1.0, condition, 60) @ q.T)
    return np.array(out), rng.standard_normal((60, 5))


def test_every_column_of_a_batch_is_solved(systems, device):
    matrix, right = systems
    k = pcg.kernels(wp.float64)
    x, done, negative = pcg.solve(k, by_numpy(matrix, device), wp.clone, wp.array(right, dtype=wp.float64, device=device),
                                  tolerance=np.full(5, 1e-10), iterations=400)
    exact = np.stack([np.linalg.solve(matrix[i], right[:, i]) for i in range(5)], axis=1)
    # relative residual 1e-10 times the condition number bounds the error
    error = np.abs(x.numpy() - exact).max(axis=0) / np.abs(exact).max(axis=0)
    assert (error < 1e-9 * np.array([1.0, 10.0, 1e2, 1e3, 1e4])).all()
    assert not negative.any() and done < 400
    # the column of condition 1 was done after one step and then frozen: it must not have been spoilt
    assert error[0] < 1e-14


def test_a_column_keeps_its_own_tolerance(systems, device):
    matrix, right = systems
    tolerance = np.array([1e-1, 1e-6, 1e-1, 1e-8, 1e-1])
    x, _, _ = pcg.solve(pcg.kernels(wp.float64), by_numpy(matrix, device), wp.clone, wp.array(right, dtype=wp.float64, device=device),
                        tolerance=tolerance, iterations=400)
    residual = np.linalg.norm(right - np.einsum("kij,jk->ik", matrix, x.numpy()), axis=0) / np.linalg.norm(right, axis=0)
    assert (residual <= 1.01 * tolerance).all()
    assert residual[2] > 1e-6 and residual[4] > 1e-6, "loose columns were meant to stop early"


def test_an_exact_preconditioner_needs_one_iteration(systems, device):
    matrix, right = systems
    inverse = np.linalg.inv(matrix)
    _, done, _ = pcg.solve(pcg.kernels(wp.float64), by_numpy(matrix, device), by_numpy(inverse, device),
                           wp.array(right, dtype=wp.float64, device=device), tolerance=np.full(5, 1e-6), iterations=50)
    assert done == 1


def test_negative_curvature_is_flagged_in_its_column_only(systems, device):
    matrix, right = systems
    bent = matrix.copy()
    values, vectors = np.linalg.eigh(bent[1])
    values[0] = -5.0
    bent[1] = vectors * values @ vectors.T
    bent[3] = -bent[3]
    x, _, negative = pcg.solve(pcg.kernels(wp.float64), by_numpy(bent, device), wp.clone, wp.array(right, dtype=wp.float64, device=device),
                               tolerance=np.full(5, 1e-10), iterations=400)
    assert negative.tolist() == [False, True, False, True, False]
    x = x.numpy()
    assert np.isfinite(x).all()
    # at the first step of all: the steepest direction itself, so that a line search has something to go along
    assert np.array_equal(x[:, 3], right[:, 3])
    for i in (0, 2, 4):
        assert np.abs(x[:, i] - np.linalg.solve(matrix[i], right[:, i])).max() < 1e-5 * np.abs(x[:, i]).max()


def test_the_iteration_limit_is_kept(systems, device):
    matrix, right = systems
    _, done, _ = pcg.solve(pcg.kernels(wp.float64), by_numpy(matrix, device), wp.clone, wp.array(right, dtype=wp.float64, device=device),
                           tolerance=np.full(5, 1e-12), iterations=7)
    assert done == 7


def test_dots_are_the_same_on_every_run_and_right(device):
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 10_007, 3))
    arrays = [wp.array(v, dtype=wp.float64, device=device) for v in (a, b)]
    first = pcg.column_dots(pcg.kernels(wp.float64), *arrays)
    # 1e4 terms of size 1, rounding of each 1e-16
    assert np.abs(first - (a * b).sum(axis=0)).max() < 1e-11
    assert np.array_equal(first, pcg.column_dots(pcg.kernels(wp.float64), *arrays))


# ------------------------------------------------------------------------------------------ the factor


@pytest.fixture(scope="module")
def model(block):
    return block((0.06, 0.06, 0.04), 0.02, young_modulus=lambda x: np.where(x[..., 0] > 0.0, 1e4, 1e8), poisson_ratio=0.45)


def test_factor_solves_with_a_contrast_of_ten_thousand(model):
    rng = np.random.default_rng(0)
    right = rng.standard_normal((len(model.free), 70)) * model.free[:, None]  # more than one chunk of 64
    x = model.factor.solve(right)
    residual = (model.factor.stiffness @ x) * model.free[:, None] - right
    # backward stable: |r| <= a few n eps |K| |x|
    scale = abs(model.factor.stiffness).sum(axis=1).max() * np.abs(x).max()
    assert np.abs(residual).max() < 1e-13 * scale
    assert not x[model.free == 0.0].any()


def test_compliance_is_symmetric_and_equal_to_direct_solves(model):
    top = np.flatnonzero(model.mesh.points[:, 2] == 0.04)
    first, later = top[: len(top) // 2], top
    model.factor.compliance(first)  # some columns are kept from before
    a = model.factor.compliance(later)
    assert np.array_equal(a, a.T)
    right = np.zeros((len(model.free), 3))
    node = later[7]
    right[3 * node + np.arange(3), np.arange(3)] = 1.0
    direct = model.factor.solve(right).reshape(-1, 3, 3)[later].reshape(-1, 3)
    # solved together with others or alone: rounding of the factor at contrast 1e4
    assert np.abs(a[:, 21:24] - direct).max() < 1e-9 * np.abs(direct).max()
    assert np.linalg.eigvalsh(a).min() > 0.0


def test_preconditioner_is_the_exact_inverse_at_rest_with_contact(model, device):
    """Woodbury: at rest the tangent is K0 + G^T D G, and one iteration must do, though the contact is 1e3 times stiffer."""
    probe = Sphere(0.02)
    poses = np.tile(np.eye(4), (1, 2, 1, 1))
    poses[0, 0, :3, 3], poses[0, 1, :3, 3] = [0.0, 0.0, 0.0585], [0.01, -0.01, 0.0575]
    solver = Solver(model, probe, device=device, options=SolverOptions(cg_tolerance=1e-6, cg_far=1.0))
    solver.touching = Touching(model, probe, poses, device=device, real=wp.float64)
    solver.elasticity.begin(2)
    columns = np.arange(2)
    solver._set(np.zeros((len(model.free), 2)))
    state = solver._evaluate(columns, poses[0])
    assert solver.touching.touches(0) and solver.touching.touches(1)
    solver.elasticity.tangent(solver._index(columns), solver.u, projected=False)
    direction, steps, negative = solver._newton_direction(columns, state["residual"], near=np.zeros(2, bool))
    assert steps == 1 and not negative.any()
    # and it is the solution of that system
    for b in range(2):
        rows, stiffness, _ = solver.touching.rows(b, geometric=False)
        dof = solver.touching.dof(b)
        product = (model.factor.stiffness @ direction[:, b]) * model.free
        product[dof] += rows.T @ (stiffness * (rows @ direction[dof, b]))
        assert np.abs(product - state["residual"][:, b]).max() < 1e-5 * np.abs(state["residual"][:, b]).max()
