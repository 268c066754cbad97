"""Conjugate gradients for several columns, as they run on a CPU and in the manner of a GPU."""

import numpy as np
import torch

from vsfsim.physics.solve import krylov
from vsfsim.physics.solve.krylov import conjugate_gradients


def repeat(step, running, *, most, few, deadline):
    """As `krylov.repeat`: in blocks, so that some repetitions are more than needed."""
    done = 0
    while done < most and int(running.sum()) > few:
        block = min(4, most - done)
        for _ in range(block):
            step()
        done += block
    return done


def system(columns=9, size=60):
    """Matrices (k, n, n) that one preconditioner serves more and more badly, and right-hand sides (n, k)."""
    random = np.random.default_rng(1)
    base = random.normal(size=(size, size))
    base = base @ base.T / size + np.eye(size)
    matrices = np.stack([base + (3.0**k - 1.0) * np.diag(random.random(size)) for k in range(columns)])
    return torch.as_tensor(matrices), torch.as_tensor(np.linalg.inv(base)), torch.as_tensor(
        random.normal(size=(size, columns)))


def test_repeated_blocks_find_what_single_iterations_find(monkeypatch):
    matrices, inverse, right = system()
    monkeypatch.setattr(krylov, "repeat", repeat)
    found = []
    for resident in (False, True):
        seen = []

        def multiply(x, which, seen=seen):
            seen.append(x.shape[1])
            own = matrices if which is None else matrices[which]
            return torch.einsum("kij,jk->ik", own, x)

        x, steps, curved = conjugate_gradients(multiply, lambda r, _: inverse @ r, right,
                                               tolerance=torch.full((9,), 1e-6), iterations=200, resident=resident)
        assert not curved.any() and steps[-1] > 2 * steps[0] and seen[-1] < 9, "columns that are done are dropped"
        exact = torch.linalg.solve(matrices, right.T[:, :, None])[:, :, 0].T
        assert torch.allclose(x, exact, rtol=0.0, atol=1e-4 * float(exact.abs().max()))
        found.append((x, steps))
    assert torch.equal(found[0][1], found[1][1])
    assert torch.allclose(found[0][0], found[1][0], rtol=1e-9, atol=1e-12)
