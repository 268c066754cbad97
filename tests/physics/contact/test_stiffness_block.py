"""The contact stiffness inverted with the compliance of the body: sparse and dense ways give the same."""

import pytest
import torch

from vsfsim.physics.contact import stiffness_block
from vsfsim.physics.contact.stiffness_block import ContactBlock, gram


@pytest.mark.parametrize("most", [0, 10**9], ids=["sparse", "dense"])
def test_forces_are_those_of_the_definition(monkeypatch, most):
    """T = (C^-1 + A)^-1 = C (1 + A C)^-1 for two touches, more rows than degrees of freedom, some of which are not
    touched."""
    monkeypatch.setattr(stiffness_block, "_SPARSE", most)
    generator = torch.Generator().manual_seed(0)

    def draw(*size):
        return torch.randn(size, dtype=torch.float64, generator=generator)

    rows = draw(2, 60, 24) * (torch.rand((2, 60, 24), generator=generator) < 0.3)
    rows[:, :, 20:] = 0.0
    half = draw(2, 24, 24)
    compliance = half @ half.mT
    v = draw(2, 24)
    stiff = rows.mT @ rows
    exact = (stiff @ torch.linalg.solve(torch.eye(24, dtype=torch.float64) + compliance @ stiff, v[:, :, None]))[..., 0]
    block = ContactBlock.of(rows, compliance)
    assert (block.pivots is not None) == (most == 0)
    assert torch.allclose(block.apply(v), exact, rtol=1e-9, atol=1e-9)
    picked = block.pick(torch.tensor([1]))
    assert torch.allclose(picked.apply(v[1:]), exact[1:], rtol=1e-9, atol=1e-9)
    assert torch.allclose(gram(rows), stiff, rtol=1e-12, atol=1e-12)
