"""Factors of a strained body's tangent as preconditioner, of the whole of it and of the part that is strained most."""

import ctypes

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from frame_checks import from_above

from vsfsim.core.errors import MeshError
from vsfsim.core.shape import Sphere
from vsfsim.physics.linear.local_factor import LocalFactor
from vsfsim.physics.solve import tangent_factor
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.touches import Solver


def test_a_factor_that_would_come_too_late_is_not_begun(block, monkeypatch):
    model = block((0.06, 0.06, 0.03), 0.015, poisson_ratio=0.4999)
    poses = np.tile(np.eye(4), (1, 1, 1, 1))
    poses[0, 0, :3, 3] = 0.003, 0.001, 0.045 - 0.35 * 0.03
    monkeypatch.setattr(tangent_factor.TangentFactors, "_duration", lambda self: 1e9)
    monkeypatch.setattr(tangent_factor.TangentFactors, "_make", lambda *a: pytest.fail("begun"))
    Solver(model, Sphere(0.015), options=SolverOptions(seconds=100.0)).run(poses, start=from_above(poses))


def test_a_local_factor_takes_fewer_iterations_to_the_same_equilibrium(block, monkeypatch):
    """Of the nodes that a ball deforms most; without negative curvature the frames are those of the factor at rest."""
    model = block((0.06, 0.06, 0.03), 0.015, poisson_ratio=0.4999)
    poses = np.tile(np.eye(4), (2, 1, 1, 1))
    poses[:, 0, :3, 3] = np.array([0.003, 0.001, 0.045]) - np.array([0.0, 0.0, 0.03]) * [[0.02], [0.3]]
    monkeypatch.setattr(tangent_factor, "_FIRST", 10**6)  # no factor of the whole
    made = []
    make = tangent_factor.TangentFactors._make_local
    monkeypatch.setattr(tangent_factor.TangentFactors, "_make_local", lambda *a: made.append(make(*a)) or made[-1])

    def press():
        made.clear()
        return Solver(model, Sphere(0.015), options=SolverOptions(seconds=1e9)).run(poses)

    own = press()
    assert made and None not in made and own.converged.all()
    monkeypatch.setattr(tangent_factor, "_VOLUME_NEAR", 10**6)
    rest = press()
    assert not made and rest.converged.all()
    print("iterations", own.cg_iterations.ravel(), "for", rest.cg_iterations.ravel())
    assert own.cg_iterations[1] < 0.75 * rest.cg_iterations[1]
    # both are balanced to 1e-4 of the force
    assert np.abs(own.force - rest.force).max() < 2e-4 * np.abs(rest.force).max()


def test_a_local_factor_is_the_schwarz_method_and_refuses_an_indefinite_part(capfd):
    random = np.random.default_rng(3)
    a = random.normal(size=(30, 30))
    a, p, at = a @ a.T + np.eye(30), np.diag(random.uniform(0.5, 2.0, 30)), np.array([3, 4, 7, 20, 21])
    local = LocalFactor(sp.csr_matrix(a[at]), at, touched=np.array([3, 7, 29]))
    part = np.zeros((30, 30))
    part[np.ix_(at, at)] = np.linalg.inv(a[np.ix_(at, at)])
    right = random.normal(size=30)
    own, left = local.before(right)
    expected = part @ right + (np.eye(30) - part @ a) @ p @ (right - a @ part @ right)
    np.testing.assert_allclose(local.after(right, own, p @ left), expected, atol=1e-9 * np.abs(expected).max())
    assert local.holds(np.array([7])) and not local.holds(np.array([7, 29])), "29 has no row in it"
    with pytest.raises(MeshError, match="positive definite"):
        LocalFactor(sp.csr_matrix(a[at] - 200.0 * np.eye(30)[at]), at, touched=at)
    ctypes.CDLL(None).fflush(None)
    assert capfd.readouterr().out == "", "CHOLMOD's warning went into the user's table or JSON"


@pytest.fixture
def factors(block):
    """The factors of a pressed block, at the beginning of a frame."""
    poses = np.tile(np.eye(4), (1, 1, 1, 1))
    poses[0, 0, :3, 3] = 0.003, 0.001, 0.045 - 0.0006
    solver = Solver(block((0.06, 0.06, 0.03), 0.015), Sphere(0.015), options=SolverOptions(seconds=1e9))
    assert solver.run(poses).converged.all()
    solver._balance.reset_counts()
    return solver._balance.factors


def note(factors, number):
    """Note a linear system of so many iterations: whether a factor of the whole is made then, and a local one."""
    before = factors._own[0], factors._local[0]
    factors.count(torch.tensor([0]), torch.tensor([number]))
    factors.renew(torch.tensor([0]), torch.zeros(len(factors._model.free), 1, dtype=torch.float64), float("inf"))
    return factors._own[0] is not before[0], factors._local[0] not in (None, before[1])


def test_a_factor_of_the_whole_has_its_turn_before_yet_another_local_one(factors, monkeypatch):
    """Local factors that took 17 to 60 iterations were made again in every step, and never one of the whole (cells
    ee1cc93f7ff3 and 1905bbb0a1a2 of the stability map: 150 iterations for 3)."""
    monkeypatch.setattr(factors, "_make", lambda *a: object())
    monkeypatch.setattr(factors, "_make_local", lambda *a: object())
    assert note(factors, 30) == (False, True)
    due = max(tangent_factor._FIRST, factors._order.work / tangent_factor._WORK)
    spent = 0
    while spent <= due:
        assert factors._own[0] is None
        made = note(factors, 30)
        spent += 30 - tangent_factor._USUAL
    assert made == (True, False)


def test_a_touch_whose_factor_of_the_whole_was_dropped_has_a_local_one(factors, monkeypatch):
    """It went on with the factor at rest, 150 iterations a step (cell 674e54049ed1 of the stability map, where one of
    the whole rounds to an indefinite one)."""
    monkeypatch.setattr(factors, "_make", lambda *a: pytest.fail("another one of the whole"))
    monkeypatch.setattr(factors, "_make_local", lambda *a: object())
    factors._own[0] = object()
    assert factors.drop(torch.tensor([0])) and factors.of(0) is None
    assert note(factors, 150) == (False, True)
    factors.drop(torch.tensor([0]))
    assert note(factors, 150) == (False, False), "the local one did not help either"
