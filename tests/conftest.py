"""What physics tests share: the device they run on, and blocks ready for the solver."""

import numpy as np
import pytest

from vsfsim.core.solid import Solid


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device of the physics tests: cpu or cuda:0.")


@pytest.fixture(scope="session")
def device(request):
    return request.config.getoption("--device")


@pytest.fixture(scope="session")
def block(device):
    """Makes a model of a box: block(size, resolution, young_modulus=..., ...).

    young_modulus: [Pa], or a function of the Gauss points (m, 4, 3) [m]. focus: points near which the mesh stays fine.
    Further keywords go to `build_model`.
    """
    from vsfsim.physics.blocks import box
    from vsfsim.physics.mesh import gauss_points
    from vsfsim.physics.model import build_model

    def make(size, resolution, *, young_modulus=1e5, poisson_ratio=0.45, fixed="bottom", focus=None, **more):
        vertices, tets = box(size, resolution, focus=None if focus is None else np.asarray(focus, float))
        solid = Solid(vertices, tets, np.zeros(len(tets), int), ("body",))
        at = gauss_points(solid)
        values = young_modulus(at) if callable(young_modulus) else np.full(at.shape[:2], float(young_modulus))
        return build_model(solid, values, poisson_ratio=poisson_ratio, fixed=fixed, bottom_tolerance=1e-6 * size[2],
                           where="test", device=device, **more)

    return make


@pytest.fixture(scope="session")
def line():
    """Makes poses (T, 1, 4, 4) of a probe at given positions (T, 3) [m], turned towards ``axis``: line(positions, probe, axis)."""
    from vsfsim.robot.press import turn_to

    def make(positions, probe, axis=(0.0, 0.0, -1.0)):
        positions = np.asarray(positions, float)
        poses = np.tile(np.eye(4), (len(positions), 1, 1, 1))
        poses[:, 0, :3, :3] = turn_to(np.asarray(axis, float), probe)
        poses[:, 0, :3, 3] = positions
        return poses

    return make
