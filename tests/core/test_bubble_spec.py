"""The [sensor] table: defaults, bounds, and what is refused."""

import pytest

from vsfsim.core.bubble import Bubble
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene

PLACE = ('[[obstacles]]\nshape = { sphere = 0.003 }\npose = [0.0, 0.0, 0.0]\n[press]\nfrom = [0, 0, 0.04]\nto = '
         '[0, 0, 0.03]\n')


def scene(sensor, rest=PLACE):
    return parse_scene(f'{rest}\n[sensor]\n{sensor}\n', "bubble.toml").sample(0)


def test_defaults_are_the_real_punyo():
    read = scene('kind = "bubble"')
    assert read.sensor == Bubble() and read.object is None
    assert [b.radius for b in read.bodies] == [0.003] and read.frictions == (Bubble().friction,)
    assert (620.0 <= Bubble().modulus <= 740.0 and 7.1e3 <= Bubble().gauge_pressure <= 8.2e3
            and Bubble().gas_volume == 150e-6)


def test_every_key_is_read():
    given = ('kind = "bubble"\nsemi_axes = [0.05, 0.04]\nyoung_modulus = 1e6\nthickness = 0.001\npre_stretch = '
             '1.2\ngauge_pressure = 5e3\ngas_volume = 2e-4\nchamber = 0.01\n'
             'gamma = 1.0\nambient_pressure = 9e4\nsealed = false\nnodes = 500\ncontact_edge = 1e-3\nfriction = '
             '0.5\nfine = true')
    assert scene(given).sensor == Bubble((0.05, 0.04), 1e6, 0.001, 1.2, 5e3, 2e-4, 0.01, 1.0, 9e4, False, 500, 1e-3,
                                         0.5, True)


@pytest.mark.parametrize(("sensor", "message"), [
    ('shape = { sphere = 1 }', r"\[sensor\]: unknown key 'shape'"),
    ('kind = "buble"', r"kind is 'buble'\. Did you mean 'bubble'\?"),
    ("nodes = 390", "kind is missing"), ('kind = "bubble"\nguage_pressure = 1', "Did you mean 'gauge_pressure'"),
    ('kind = "bubble"\nsemi_axes = [0.04, 0.05]', "the first not the smaller"),
    ('kind = "bubble"\nsemi_axes = [0.5, 0.04]', "at most ten times"),
    ('kind = "bubble"\nnodes = 99', "whole number from 100 to 20000"),
    ('kind = "bubble"\npre_stretch = 0.9', "pre_stretch is 0.9"), ('kind = "bubble"\ngamma = 0.9', "gamma is 0.9"),
    ('kind = "bubble"\nsealed = 1', "it must be true"), ('kind = "bubble"\nthickness = 0.01', "thickness is 0.01"),
    ('kind = "bubble"\nyoung_modulus = nan', "young_modulus is nan"),
])
def test_mistakes_are_refused(sensor, message):
    with pytest.raises(SceneError, match=message):
        scene(sensor)


def test_what_moves_and_what_it_meets():
    with pytest.raises(SceneError, match=r"a \[sensor\] and a \[probe\]"):
        scene('kind = "bubble"', PLACE + "[probe]\nshape = { sphere = 0.02 }\n")
    with pytest.raises(SceneError, match=r"there is no \[object\].*\[\[obstacles\]\] for the \[sensor\]"):
        scene('kind = "bubble"', "")


def test_the_camera_inside_is_on_or_has_two_numbers_of_pixels():
    assert scene('kind = "bubble"').sensor.camera is None
    assert scene('kind = "bubble"\ncamera = true').sensor.camera == (640, 480)
    assert scene('kind = "bubble"\ncamera = [8, 4096]').sensor.camera == (8, 4096)
    for wrong in ("[7, 240]", "[320, 4097]", "[320]", "[320.0, 240]", "[true, 240]", '"large"'):
        with pytest.raises(SceneError, match=r"camera(\[\d\])? is"):
            scene(f'kind = "bubble"\ncamera = {wrong}')
