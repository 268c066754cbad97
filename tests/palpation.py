"""A synthetic palpation: a dome pressed into a volume of known stiffness, with the force on each of its vertices.

The forces are those of the continuous VSF itself (Neural VSF eq. 4), not of the simulator, integrated finely along the
path of each vertex. They are a workload and a ground truth for estimators that read dense contact forces.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vsfsim.bench.method import Action, Reading, Surface
from vsfsim.core.shape import ProbeShape
from vsfsim.vsf.fields.line_integrals import SurfaceTouch, dome, oriented_areas

Field = Callable[[np.ndarray], np.ndarray]


def palpate(field: Field, *, touches: int, frames: int, extent: tuple[float, float], depth: float = 0.012,
            rings: int = 8, tilt: float = 0.2, noise: float = 0.0, substeps: int = 20,
            seed: int = 0) -> list[SurfaceTouch]:
    """Press the dome at random places of the plane z = 0 into the half-space under it.

    Args:
        field: stiffness density at points (k, 3) -> (k,) [N/m^4]; 0 above z = 0.
        touches: number of touches, each along a straight line.
        frames: number of frames of a touch, in equal steps.
        extent: edges of the region of targets, centred on the origin (2,) [m].
        depth: of the apex at the end [m].
        rings: of the dome.
        tilt: largest angle from vertical, about x and about y [rad].
        noise: standard deviation of every force component [N].
        substeps: of the integral, in each frame.
        seed: >= 0.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    shape, triangles = dome(rings=rings)
    out = []
    for _ in range(touches):
        target = np.append(rng.uniform(-0.5, 0.5, 2) * extent, 0.0)
        lean = rng.uniform(-tilt, tilt, 2)
        c, s = np.cos(lean), np.sin(lean)
        about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
        turn = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]]) @ about_x
        travel = np.linspace(0.002, -depth, frames)
        base = shape @ turn.T + target
        vertices = base + travel[:, None, None] * turn[:, 2]
        force = _forces(field, base, oriented_areas(base, triangles), turn[:, 2], travel, substeps)
        out.append(SurfaceTouch(vertices, triangles, force + noise * rng.standard_normal(force.shape)))
    return out


def _forces(field: Field, base: np.ndarray, area: np.ndarray, up: np.ndarray, travel: np.ndarray,
            substeps: int) -> np.ndarray:
    """Eq. 4 for a straight path, by midpoints of ``substeps`` steps a frame: f(t) is the sum of -K(p) (v(t) - p) s . dv
    along the path."""
    count = (len(travel) - 1) * substeps
    ends = np.linspace(travel[0], travel[-1], count + 1)
    middle = 0.5 * (ends[1:] + ends[:-1])
    points = base + middle[:, None, None] * up
    k = field(points.reshape(-1, 3)).reshape(count, len(base))
    volume = (ends[1] - ends[0]) * (area @ up)
    first, second = np.cumsum(k, axis=0), np.cumsum(k * middle[:, None], axis=0)
    force = np.zeros((len(travel), len(base), 3))
    for t in range(1, len(travel)):
        n = t * substeps - 1
        force[t] = -((travel[t] * first[n] - second[n]) * volume)[:, None] * up
    return force


def layer_with_inclusion(*, soft: float = 2e8, stiff: float = 4e9, top: float = -0.004, radius: float = 0.008,
                         path: Callable[[np.ndarray], np.ndarray] | None = None) -> Field:
    """A soft half-space under z = 0 with a stiff rope in it (Neural VSF section IV-A).

    Args:
        soft: stiffness density of the half-space [N/m^4].
        stiff: stiffness density of the rope [N/m^4].
        top: z of the rope's upper side [m].
        radius: of the rope [m].
        path: y of the rope's middle line as a function of x [m]; None for a sine of 2 cm over 12 cm.
    """
    middle = path or (lambda x: 0.02 * np.sin(2.0 * np.pi * x / 0.12))

    def field(points: np.ndarray) -> np.ndarray:
        away = np.hypot(points[:, 1] - middle(points[:, 0]), points[:, 2] - (top - radius))
        return np.where(points[:, 2] > 0.0, 0.0, np.where(away < radius, stiff, soft))

    return field


def two_halves(points: np.ndarray) -> np.ndarray:
    """Stiffness density (k,) [N/m^4] of a half-space under z = 0 that is ten times as stiff where x > 0."""
    return np.where(points[:, 2] > 0, 0.0, np.where(points[:, 0] > 0, 4e9, 4e8))


def skin_readings(touches: list[SurfaceTouch], probe: ProbeShape, place: Callable[[np.ndarray], np.ndarray],
                  *, top: float = 0.03) -> list[Reading]:
    """The touches as a sensor with a skin reads them on a ground whose top is at z = ``top`` [m]: the force upwards,
    and that on each vertex. ``place`` gives the sensor's origin (T, 3) [m] from its vertices (T, n, 3) [m]."""
    out = []
    for touch in touches:
        vertices, frames = touch.vertices + [0.0, 0.0, top], len(touch.vertices)
        poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (frames, 1, 1))  # +z out of the dome, towards the object
        poses[:, :3, 3] = place(vertices)
        action = Action(np.arange(float(frames)), poses, np.array([0.0, 0.0, -1.0]), probe, "normal-force", 1)
        out.append(Reading(action, touch.force.sum(axis=1)[:, 2:], np.ones(frames, bool),
                           Surface(vertices, touch.force)))
    return out
