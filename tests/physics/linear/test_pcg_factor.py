"""Conjugate gradients by columns, the rest-state factor, and the preconditioner made of it."""


import numpy as np
import pytest
import scipy.sparse as sp
import torch
import warp as wp
from frame_checks import dense

from vsfsim.core.shape import Sphere
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.linear.rest_factor import RestFactor, response, spread
from vsfsim.physics.solve import krylov
from vsfsim.physics.solve.direction import newton_direction
from vsfsim.physics.solve.newton import Equilibrium
from vsfsim.physics.solve.touches import Solver, SolverOptions


def by_numpy(matrix, device):
    table = torch.as_tensor(matrix, device=device)
    return lambda x, which: torch.einsum("kij,jk->ik", table if which is None else table[which], x)


def solve(multiply, precondition, right, device, tolerance, iterations):
    limits = torch.as_tensor(np.broadcast_to(tolerance, right.shape[1]).copy(), device=device)
    x, done, negative = krylov.conjugate_gradients(
        multiply, precondition, torch.as_tensor(right, device=device), tolerance=limits, iterations=iterations)
    return x.cpu().numpy(), done.cpu().numpy(), negative.cpu().numpy()


def nothing(x, which):
    return x.clone()


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
    x, done, negative = solve(by_numpy(matrix, device), nothing, right, device, 1e-10, 400)
    exact = np.stack([np.linalg.solve(matrix[i], right[:, i]) for i in range(5)], axis=1)
    # relative residual 1e-10 times the condition number bounds the error
    error = np.abs(x - exact).max(axis=0) / np.abs(exact).max(axis=0)
    assert (error < 1e-9 * np.array([1.0, 10.0, 1e2, 1e3, 1e4])).all()
    assert not negative.any() and (done < 400).all()
    assert (np.diff(done) > 0).all(), "the worse the condition the more iterations, counted for each column"
    # the column of condition 1 was done after one step and then frozen: it must not have been spoilt
    assert error[0] < 1e-14


def test_a_column_keeps_its_own_tolerance(systems, device):
    matrix, right = systems
    tolerance = np.array([1e-1, 1e-6, 1e-1, 1e-8, 1e-1])
    x, _, _ = solve(by_numpy(matrix, device), nothing, right, device, tolerance, 400)
    residual = np.linalg.norm(right - np.einsum("kij,jk->ik", matrix, x), axis=0) / np.linalg.norm(right, axis=0)
    assert (residual <= 1.01 * tolerance).all()
    assert residual[2] > 1e-6 and residual[4] > 1e-6, "loose columns were meant to stop early"


def test_an_exact_preconditioner_needs_one_iteration(systems, device):
    matrix, right = systems
    inverse = np.linalg.inv(matrix)
    _, done, _ = solve(by_numpy(matrix, device), by_numpy(inverse, device), right, device, 1e-6, 50)
    assert (done == 1).all()


def test_negative_curvature_is_flagged_in_its_column_only(systems, device):
    matrix, right = systems
    bent = matrix.copy()
    values, vectors = np.linalg.eigh(bent[1])
    values[0] = -5.0
    bent[1] = vectors * values @ vectors.T
    bent[3] = -bent[3]
    x, _, negative = solve(by_numpy(bent, device), nothing, right, device, 1e-10, 400)
    assert negative.tolist() == [False, True, False, True, False]
    assert np.isfinite(x).all()
    # at the first step of all: the steepest direction itself, so that a line search has something to go along
    assert np.array_equal(x[:, 3], right[:, 3])
    for i in (0, 2, 4):
        assert np.abs(x[:, i] - np.linalg.solve(matrix[i], right[:, i])).max() < 1e-5 * np.abs(x[:, i]).max()


def test_the_iteration_limit_is_kept(systems, device):
    matrix, right = systems
    _, done, _ = solve(by_numpy(matrix, device), nothing, right, device, 1e-12, 7)
    assert done.max() == 7 and done[0] == 1


def test_dots_are_the_same_on_every_run_and_right(device):
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 10_007, 3))
    arrays = [torch.as_tensor(v, device=device) for v in (a, b)]
    first = krylov.column_dots(*arrays).cpu().numpy()
    # 1e4 terms of size 1, rounding of each 1e-16
    assert np.abs(first - (a * b).sum(axis=0)).max() < 1e-11
    assert np.array_equal(first, krylov.column_dots(*arrays).cpu().numpy())


# ------------------------------------------------------------------------------------------ the factor


@pytest.fixture(scope="module")
def model(block):
    return block((0.06, 0.06, 0.04), 0.02, young_modulus=lambda x: np.where(x[..., 0] > 0.0, 1e4, 1e8),
                 poisson_ratio=0.45)


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
    dof = (3 * later[:, None] + np.arange(3)).ravel()
    model.factor.columns(first)  # some are kept from before
    a = model.factor.columns(later)[:, dof]
    # one solve a column: rounding of the factor at contrast 1e4
    assert np.abs(a - a.T).max() < 1e-9 * np.abs(a).max()
    assert np.array_equal(model.factor.columns(first)[:, dof], a[:3 * len(first)])
    right = np.zeros((len(model.free), 3))
    node = later[7]
    right[3 * node + np.arange(3), np.arange(3)] = 1.0
    direct = model.factor.solve(right).reshape(-1, 3, 3)[later].reshape(-1, 3)
    # solved together with others or alone: rounding of the factor at contrast 1e4
    assert np.abs(a[21:24].T - direct).max() < 1e-9 * np.abs(direct).max()
    assert np.linalg.eigvalsh(0.5 * (a + a.T)).min() > 0.0


def test_columns_that_no_longer_fit_are_made_again(model):
    top = np.flatnonzero(model.mesh.points[:, 2] == 0.04)
    small = RestFactor(model.factor.stiffness, model.free, model.mesh.points)
    small.columns_bytes = 4.0 * small.size * 3 * 12
    expected = small.columns(top[:12])
    small.columns(top[8:20])  # known ones and new ones, more together than are kept
    assert len(small._columns) == 12
    again = small.columns(top[:12])
    assert again == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_preconditioner_is_the_exact_inverse_at_rest_with_contact(model, device):
    """Woodbury: at rest the tangent is K0 + G^T D G, and two iterations must do, of which the second takes away what
    single precision left, though the contact is 1e3 times stiffer."""
    probe = Sphere(0.02)
    poses = np.tile(np.eye(4), (1, 2, 1, 1))
    poses[0, 0, :3, 3], poses[0, 1, :3, 3] = [0.0, 0.0, 0.0585], [0.01, -0.01, 0.0575]
    solver = Solver(model, probe, device=device)
    solver.elasticity.begin(2)
    contact = RigidContact(model, RigidBodies(probe), np.zeros(1), poses[:, :, None], device=device)
    balance = Equilibrium(model, solver.elasticity, contact, SolverOptions(), floor=1e-12)
    contact.begin_step(poses[0][:, None], balance.u)
    contact.move(poses[0][:, None])
    state = balance.evaluate(balance.every)
    assert contact.touches(balance.every).all()
    every = balance.every
    solver.elasticity.tangent(wp.from_torch(every.to(torch.int32)), wp.from_torch(balance.u), projected=False)
    near = torch.zeros_like(every, dtype=torch.bool)
    stiffness = dense(contact.stiffness(every, near))
    direction, steps, negative = newton_direction(
        solver.elasticity, contact, every, state["residual"], near=near,
        tolerance=torch.full((2,), 1e-6, dtype=torch.float64, device=device), iterations=150)
    assert (steps <= 2).all() and not negative.any()
    # and it is the solution of that system
    for b in range(2):
        dof = contact.dof[b].cpu().numpy()
        used = dof >= 0
        d = direction[:, b].cpu().numpy()
        product = (model.factor.stiffness @ d) * model.free
        product[dof[used]] += (stiffness[b][:, used] @ d[dof[used]])[used]
        residual = state["residual"][:, b].cpu().numpy()
        assert np.abs(product - residual).max() < 1e-5 * np.abs(residual).max()


def test_the_same_matrix_is_factorised_once(model):
    """By content: an equal stiffness made anew finds the factor; another support does not."""
    again = model.factor.stiffness.copy()
    first = RestFactor.of(again, model.free, model.mesh.points)
    assert RestFactor.of(again.copy(), model.free.copy(), model.mesh.points) is first
    other = model.free.copy()
    other[np.flatnonzero(other == 1.0)[:3]] = 0.0
    assert RestFactor.of(again, other, model.mesh.points) is not first


@pytest.mark.parametrize("few", [True, False], ids=["columns kept", "triangular solves"])
def test_forces_on_patches_are_answered_like_forces_on_the_body(model, device, few):
    surface = model.mesh.surface_nodes()
    rng = np.random.default_rng(0)
    count = 2 if few else 6
    nodes = np.stack([rng.choice(surface, 9, replace=False) for _ in range(count)])
    dof = (3 * nodes[:, :, None] + np.arange(3)).reshape(count, -1)
    dof[1, -6:] = -1
    table = torch.as_tensor(dof, device=device)
    answer = response(model.factor, table, device=device)
    answer.prepare(table[:, ::3] >= 0)
    force = torch.as_tensor(rng.standard_normal(dof.shape) * (dof >= 0), device=device)
    which = torch.tensor([1, 0], device=device)
    whole = spread(table[which], force[which], len(model.free)) * torch.as_tensor(model.free, device=device)[:, None]
    expected = answer.solve(whole)
    # K^-1 f by columns or at once: single precision
    assert (answer.patch(which, force[which]) - expected).abs().max() < 1e-6 * expected.abs().max()
    compliance = answer.compliance()[0]
    assert (compliance @ force[0] - expected[table[0], 1]).abs().max() < 1e-6 * expected.abs().max()


def test_conjugate_gradients_end_at_the_deadline():
    """Time that is over leaves the first step, along which the energy falls."""
    rng = np.random.default_rng(7)
    root = rng.standard_normal((40, 40))
    matrix, right = torch.as_tensor(root @ root.T + np.eye(40)), torch.as_tensor(rng.standard_normal((40, 3)))
    x, steps, negative = krylov.conjugate_gradients(lambda p, _: matrix @ p, lambda r, _: r.clone(), right,
                                   tolerance=torch.full((3,), 1e-12, dtype=torch.float64), iterations=100, deadline=0.0)
    assert steps.tolist() == [1, 1, 1] and not negative.any()
    assert ((0.5 * x * (matrix @ x) - right * x).sum(dim=0) < 0.0).all()


def test_a_new_body_frees_the_columns_of_the_body_before():
    """A generator makes one object after the other; the columns of all would be gigabytes."""

    def body(modulus):
        matrix = modulus * (3.0 * np.eye(60) + np.eye(60, k=1) + np.eye(60, k=-1))
        return RestFactor.of(sp.csr_matrix(matrix), np.ones(60), np.eye(20, 3))

    one = body(1.0)
    before = one.columns(np.arange(8))
    assert len(one._columns) == 8
    assert body(1.0) is one and len(one._columns) == 8, "the same body keeps them"
    body(2.0)
    assert not one._columns
    np.testing.assert_array_equal(one.columns(np.arange(8)), before)
