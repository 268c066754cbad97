"""The contact stiffness inverted with the compliance of the body, symmetric or not."""

import pytest
import scipy.sparse as sp
import torch

from vsfsim.physics.contact.stiffness_block import ContactBlock, SparseStiffness, assembled


@pytest.fixture
def draw():
    """Random numbers of a given size, the same in every run."""
    generator = torch.Generator().manual_seed(0)
    return lambda *size: torch.randn(size, dtype=torch.float64, generator=generator)


def pushed(stiff, compliance, v):
    """T v with T = (C^-1 + A)^-1 = C (1 + A C)^-1, by its definition."""
    eye = torch.eye(stiff.shape[1], dtype=torch.float64)
    return (stiff @ torch.linalg.solve(eye + compliance @ stiff, v[:, :, None]))[..., 0]


@pytest.mark.parametrize("sparse", [False, True])
def test_forces_are_those_of_the_definition(draw, sparse):
    """Two touches, some of whose degrees of freedom are not touched."""
    rows = draw(2, 60, 24) * (draw(2, 60, 24) < -0.5)
    rows[:, :, 20:] = 0.0
    half = draw(2, 24, 24)
    compliance, v = half @ half.mT, draw(2, 24)
    stiff = rows.mT @ rows
    exact = pushed(stiff, compliance, v)
    block = ContactBlock.of(SparseStiffness([sp.csr_matrix(c.numpy()) for c in stiff]) if sparse else stiff, compliance)
    assert block.dof.shape[1] == 20
    assert torch.allclose(block.apply(v), exact, rtol=1e-9, atol=1e-9)
    picked = block.pick(torch.tensor([1]))
    assert torch.allclose(picked.apply(v[1:]), exact[1:], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("nodes", [False, True])
def test_stiffness_from_faces_is_the_sum_over_their_points(draw, nodes):
    """Two touches of three and two faces with six points each, whose stiffness is not symmetric; one face does not
    touch, and some degrees of freedom are held."""
    local = torch.tensor([[[0, 1, 2, 3, 4, 5], [2, 1, 6, 7, 8, 3], [9, 8, 7, 6, 2, 0]],
                          [[1, 2, 3, 4, 5, 6], [7, 6, 5, 4, 3, 2], [0, 0, 0, 0, 0, 0]]], dtype=torch.int32)
    shapes, own = draw(2, 3, 6, 6), draw(2, 18, 3, 3)
    own = own @ own.mT + 0.1 * draw(2, 18, 3, 3)
    own[0, 6:12] = 0.0
    own[1, 12:] = 0.0
    free = (draw(2, 30) < 1.0).to(torch.float64)
    stiff = torch.zeros(2, 10, 3, 10, 3, dtype=torch.float64)
    for b in range(2):
        for f in range(3):
            for q in range(6):
                for i, a in enumerate(local[b, f].tolist()):
                    for j, c in enumerate(local[b, f].tolist()):
                        stiff[b, a, :, c] += shapes[b, f, q, i] * shapes[b, f, q, j] * own[b, 6 * f + q]
    stiff = stiff.view(2, 30, 30) * free[:, :, None] * free[:, None, :]
    found = assembled(local, shapes, own, free)
    half, v = draw(2, 30, 30), draw(2, 30)
    compliance = half @ half.mT
    assert torch.allclose(found @ v[:, :, None], stiff @ v[:, :, None], rtol=1e-12, atol=1e-12)
    assert torch.allclose(found[torch.tensor([1])] @ v[1:, :, None], stiff[1:] @ v[1:, :, None], rtol=1e-12, atol=1e-12)
    block = ContactBlock.of(found, compliance, nodes=nodes)
    assert torch.allclose(block.apply(v), pushed(stiff, compliance, v), rtol=1e-8, atol=1e-8)
