"""Sums over quadratic faces, and values at their points, on random patches."""

import numpy as np
import torch

from vsfsim.physics.contact.patch import at_points, nodal_sums

TOUCHES, FACES, NODES = 3, 5, 11


def test_values_at_points_are_weighted_by_the_shapes_that_forces_are_spread_by():
    """The two are each other's transpose (virtual work), and every point has the value of a constant field."""
    rng = np.random.default_rng(0)
    local = torch.as_tensor(np.stack([[rng.choice(NODES, 6, replace=False) for _ in range(FACES)]
                                      for _ in range(TOUCHES)]))
    shapes = torch.as_tensor(rng.standard_normal((TOUCHES, FACES, 6, 6)))
    shapes = shapes / shapes.sum(dim=3, keepdim=True)
    force = torch.as_tensor(rng.standard_normal((TOUCHES, 6 * FACES, 3)))
    moved = torch.as_tensor(rng.standard_normal((TOUCHES, 3 * NODES)))
    there = at_points(local, shapes, moved.view(TOUCHES, NODES, 3))
    assert torch.allclose((there * force).sum(dim=(1, 2)),
                          (moved * nodal_sums(local, shapes, force, NODES).flatten(1)).sum(dim=1), rtol=1e-12)
    constant = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    assert torch.allclose(at_points(local, shapes, constant.expand(TOUCHES, NODES, 3)), constant.expand_as(there))
