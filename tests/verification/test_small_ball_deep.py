"""A ball of 5 mm that is pushed six radii deep into a soft block."""

import numpy as np
import pytest

from vsfsim.press.command import press

SCENE = """
name = "deep-ball"
description = "A ball of 5 mm on a block of S1"
needs = ["normal-force", "bulging"]
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ box = [0.10, 0.10, 0.05] }}
fixed = "bottom"
poisson_ratio = 0.45
young_modulus = 1e5
friction = {friction}
[probe]
shape = {{ sphere = 0.005 }}
[press]
from = [0.0, 0.0, 0.055]
to = [0.0, 0.0, 0.025]
frames = 20
"""


@pytest.mark.slow
def test_a_ball_that_sticks_goes_six_radii_deep(tmp_path, device):
    """As rubber does (friction 1). Without friction the surface slides around the ball from 24 mm on, where no
    equilibrium is left (docs/limits.md)."""
    (tmp_path / "deep-ball.toml").write_text(SCENE.format(friction=1.0))
    result = press(tmp_path / "deep-ball.toml", tier="fem-coarse", device=device, limit=120.0).result
    assert result.converged.all() and result.audit["min_det_f"].min() > 0.15
    force, energy, depth = result.force[:, 2], result.audit["energy"], result.depth
    assert depth[-1] == pytest.approx(0.03) and (np.diff(force) > 0.0).all()
    assert np.abs(result.force[:, :2]).max() < 1e-3 * force[-1], "symmetric"
    between = 0.5 * (force[1:] + force[:-1]) * np.diff(depth)
    work = np.cumsum([0.4 * force[0] * depth[0], *between])  # Hertz's force, up to the first frame
    share = energy[1:] / work[1:]  # the first frame's contact radius is that of a third of an element
    assert (share < 1.0).all() and (share > 0.97).all(), "friction takes the rest"
