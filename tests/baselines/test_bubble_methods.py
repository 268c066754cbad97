"""The methods on touches of a bubble: its pressure, its skin, and the undented dome that they are told."""

import numpy as np
import pytest

from vsfsim.baselines.field_vsf import GridVsf
from vsfsim.baselines.point_vsf import DenseVsf, PointVsf
from vsfsim.bench.method import Action, Reading, Surface
from vsfsim.bench.mock import mock_view
from vsfsim.core.dome import Dome
from vsfsim.core.errors import MethodError
from vsfsim.vsf.palpation import dome as cap
from vsfsim.vsf.palpation import palpate

AREA = np.pi * 0.03**2
QUICK = {"iterations": 120, "batch": 400, "samples": 6}


def pressed(observation="pressure"):
    """Touches of a dome on a ground that is stiff where x > 0."""
    ground = palpate(lambda p: np.where(p[:, 2] > 0, 0.0, np.where(p[:, 0] > 0, 4e9, 4e8)), touches=10, frames=5, extent=(0.05, 0.04), rings=4, tilt=0.0)
    points, triangles = cap(rings=4)
    probe = Dome.of(points * [1.0, -1.0, -1.0] + [0.0, 0.0, 0.015], triangles)
    readings = []
    for t in ground:
        vertices = t.vertices + [0.0, 0.0, 0.03]
        poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (5, 1, 1))
        poses[:, :3, 3] = vertices[:, 0] + [0.0, 0.0, 0.015]  # the apex is the first vertex, the rim 15 mm above it
        action = Action(np.arange(5.0), poses, np.array([0.0, 0.0, -1.0]), probe, observation, 1)
        total = t.force.sum(axis=1)[:, 2:]
        readings.append(Reading(action, total / (7.18e-3 if observation == "pressure" else 1.0), np.ones(5, bool), Surface(vertices, t.force)))
    return readings


@pytest.mark.parametrize(("build", "skin"), [(PointVsf, False), (DenseVsf, True), (lambda: GridVsf(**QUICK), False), (lambda: GridVsf(**QUICK), True)])
def test_a_stiff_half_is_felt(build, skin):
    view, readings = mock_view(0).view, pressed()
    given = readings if skin else [Reading(r.action, r.value, r.valid) for r in readings]
    method = build()
    method.adapt(view, given[:8])
    stiffness = method.stiffness(np.array([[x, 0.0, 0.026] for x in (-0.012, 0.012)])).mean
    assert stiffness[1] > 2.0 * stiffness[0]
    asked = method.predict([r.action for r in readings[8:]])
    for guess, reading in zip(asked, readings[8:], strict=True):
        assert guess.shape == reading.value.shape and np.isfinite(guess).all() and guess[0, 0] == 0.0
        # the ground goes on past what the small view shows, so only the size is asked for
        assert 0.2 * reading.value[-1, 0] < guess[-1, 0] < 5.0 * reading.value[-1, 0]


def test_a_dome_in_a_message_is_short():
    readings = pressed("force-magnitude")
    with pytest.raises(MethodError, match=r"the probe is Dome\(61 vertices, 15.0 mm high, [0-9a-f]{8}\)"):
        GridVsf(**QUICK).predict([readings[0].action])
    assert len(str(readings[0].action.probe)) < 60
