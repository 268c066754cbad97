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
def block():
    """Makes a model of a box: block(size, resolution, young_modulus=..., ...).

    young_modulus: [Pa], or a function of the Gauss points (m, 4, 3) [m]. ticks: grid lines along x, y, z [m] instead of an even mesh.
    Further keywords go to `build_model`.
    """
    from vsfsim.core.hexes import split_hexes
    from vsfsim.physics.blocks import box, grid_hexes
    from vsfsim.physics.mesh import gauss_points
    from vsfsim.physics.model import build_model

    def make(size, resolution, *, young_modulus=1e5, poisson_ratio=0.45, fixed="bottom", ticks=None, **more):
        if ticks is None:
            vertices, tets = box(size, resolution)
        else:
            shape = tuple(len(t) for t in ticks)
            vertices = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
            number = np.arange(len(vertices))
            tets, _ = split_hexes(grid_hexes(number.reshape(shape)), np.indices(shape).sum(axis=0).reshape(-1) % 2 * len(number) + number)
        solid = Solid(vertices, tets, np.zeros(len(tets), int), ("body",))
        at = gauss_points(solid)
        values = young_modulus(at) if callable(young_modulus) else np.full(at.shape[:2], float(young_modulus))
        return build_model(solid, values, poisson_ratio=poisson_ratio, fixed=fixed, bottom_tolerance=1e-6 * size[2],
                           where="test", **more)

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


@pytest.fixture(scope="session")
def graded():
    """Makes ticks [m] from 0 to ``length`` that grow geometrically: graded(first, equal, growth, length), ``equal`` steps of ``first`` [m] to begin with."""

    def make(first, equal, growth, length):
        steps = [first] * equal
        while sum(steps) < length:
            steps.append(steps[-1] * growth)
        return np.concatenate([[0.0], np.cumsum(steps)]) * length / sum(steps)

    return make
