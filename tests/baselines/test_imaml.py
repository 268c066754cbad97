"""iMAML: its implicit gradient against finite differences through a fully solved inner problem, and its errors."""


import numpy as np
import pytest
import torch
from mock_methods import TASK, error, training

from vsfsim.baselines.imaml import Imaml
from vsfsim.baselines.implicit_maml import Batch, Network, adapt, implicit_gradient
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.core.errors import MethodError

torch.set_num_threads(1)


def batch(seed, tasks=2, rows=6, token=3):
    g = torch.Generator().manual_seed(seed)
    x, y = torch.randn(tasks, rows, 2, generator=g,
                       dtype=torch.float64), torch.randn(tasks, rows, 1, generator=g, dtype=torch.float64)
    weight = torch.ones(tasks, rows, dtype=torch.float64)
    weight[1, 4:] = 0.0
    return Batch(x, torch.ones(tasks, token, dtype=torch.float64), y, weight)


@pytest.mark.parametrize("token", [0, 3])
def test_the_implicit_gradient_is_the_derivative_of_the_solved_inner_problem(token):
    network = Network(2, 1, token=token, hidden=(5,), encoder=(4, 2))
    theta = network.start(torch.Generator().manual_seed(0))
    support, query = batch(1, token=token), batch(2, token=token)
    # each step leaves under 0.6 of the error: 1e-15 in the end
    solve = {"rate": 0.2, "steps": 70, "regularisation": 2.0}

    def query_loss(parameters):
        return network.loss(adapt(network, parameters, support, **solve), query)

    phi = adapt(network, theta, support, **solve)
    gradient = implicit_gradient(network, phi, support, query, steps=60, regularisation=2.0)
    rng = np.random.default_rng(0)
    for index in rng.choice(len(theta), 12, replace=False):
        step = torch.zeros_like(theta)
        step[index] = 1e-5
        ends = [query_loss(theta + sign * step) for sign in (1, -1)]
        # Central differences of a function that is smooth but for ReLU kinks, of which none is within 1e-5.
        torch.testing.assert_close(gradient[:, index], (ends[0] - ends[1]) / 2e-5, rtol=1e-4, atol=1e-8)


def test_tasks_in_a_batch_are_independent_of_each_other_and_of_the_padding():
    network = Network(2, 1, token=3, hidden=(5,), encoder=(4, 2))
    theta = network.start(torch.Generator().manual_seed(0))
    both = batch(1)
    alone = Batch(both.x[1:, :4], both.token[1:], both.y[1:, :4], both.weight[1:, :4])
    together, single = (adapt(network, theta, b, rate=0.1, steps=7, regularisation=2.0) for b in (both, alone))
    torch.testing.assert_close(together[1], single[0])
    g1, g2 = (implicit_gradient(network, *given, steps=10, regularisation=2.0, damping=100.0)
              for given in ((together, both, both), (single, alone, alone)))
    torch.testing.assert_close(g1[1], g2[0])
    far = implicit_gradient(network, together, both, both, steps=10, regularisation=2.0, damping=1e9)
    torch.testing.assert_close(far, network.gradient(together, both))  # what no curvature turns is the first order's


def test_without_support_nothing_moves():
    network = Network(2, 1, token=0, hidden=(5,), encoder=())
    theta = network.start(torch.Generator().manual_seed(0))
    empty = Batch(torch.zeros(1, 1, 2, dtype=torch.float64), torch.zeros(1, 0), torch.zeros(1, 1, 1), torch.zeros(1, 1))
    assert torch.equal(adapt(network, theta, empty, rate=0.1, steps=5, regularisation=2.0)[0], theta)


def test_single_precision_agrees_with_double():
    train, view = training(3), mock_view(10)
    answers = []
    for precision in ("float64", "float32"):
        method = Imaml(epochs=5, precision=precision)
        method.meta_fit(train)
        reading = record(view, TASK).readings
        method.adapt(view.view, reading[:3])
        answers.append(method.predict([reading[4].action])[0])
    assert answers[1].dtype == np.float64 and not np.array_equal(*answers)
    np.testing.assert_allclose(answers[1], answers[0], atol=1e-4 * np.abs(answers[0]).max())


def test_it_learns_and_adapts():
    train = training(8, touches=10)
    views = [mock_view(i, touches=20) for i in range(10, 16)]

    def log_errors(method, support):
        return np.log([error(method, view, support, range(14, 20)) for view in views])

    def ratio(first, second):
        """Geometric mean over the six objects of the ratio of two errors."""
        return float(np.exp(np.mean(first - second)))

    # A larger outer rate than the paper's, and fewer inner steps, to see in 60 steps what takes it 400. What it answers
    # before the first touch still swings from step to step; what it makes of touches does not.
    quick = {"outer_rate": 3e-3, "inner_rate": 0.01, "inner_steps": 6, "cg_steps": 3}
    raw, trained = Imaml(epochs=0, **quick), Imaml(epochs=60, **quick)
    for method in (raw, trained):
        method.meta_fit(train)
    # Over twelve seeds of the mock objects the ratios are 0.22 to 0.80 (median 0.29) and 0.32 to 0.69.
    touched = log_errors(trained, range(14))
    assert ratio(touched, log_errors(raw, range(14))) < 0.9
    assert ratio(touched, log_errors(trained, [])) < 0.85, "touches move the answer"


def test_training_that_diverges_is_refused():
    train = training(2, touches=4)
    with pytest.raises(MethodError, match="diverged"):
        Imaml(epochs=4, outer_rate=1e3, inner_rate=10.0, inner_steps=4, cg_steps=1).meta_fit(train)
