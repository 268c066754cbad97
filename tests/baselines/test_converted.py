"""Methods whose settings follow the contact and the readings: on data of other units they answer the same."""

import dataclasses
import inspect

import numpy as np
import pytest
from mock_methods import TASK, training

from vsfsim.baselines.converted import Units, enlarged, half_width
from vsfsim.baselines.surface_touches import SurfaceView
from vsfsim.bench.commands.catalogue import preset
from vsfsim.bench.method import Specimen, find_method
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.core.dome import Dome
from vsfsim.core.errors import MethodError
from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, Sphere

QUICK = {"sbml": {"networks": 2, "epochs": 2}, "cnp": {"steps": 5, "networks": 1}, "imaml": {"epochs": 2},
         "imaml-vision": {"epochs": 2}, "neural-vsf": {"iterations": 3}, "grid-vsf": {"iterations": 3}}
PARTICLES = ("gaussian", "gaussian-zero", "point-vsf", "dense-vsf", "sbml")
METHODS = (*PARTICLES, "near-springs", "surface-gp", "contact-points", "cnp", "imaml", "imaml-vision", "neural-vsf",
           "grid-vsf")


@pytest.fixture(scope="module")
def data():
    """Training objects, a view, and the readings of its touches."""
    view = mock_view(5, touches=5)
    return training(2, touches=4), view, record(view, TASK).readings


def answers(name, data, units, **more):
    """Of the preset on data in other units."""
    train, view, readings = data
    factory = find_method(name)
    given = preset(name, "tuned", "normal-force", "readings").parameters | QUICK.get(name, {}) | more
    # Particles as many as the ball of the mock meets in a second.
    method = factory(**given, **({"spacing": 0.012} if name in PARTICLES else {}))
    method.meta_fit([Specimen(s.name, units.view(s.view), tuple(map(units.touch, s.touches))) for s in train])
    method.adapt(units.view(view.view), [units.touch(r) for r in readings[:3]])
    asked = [units.action(r.action) for r in readings[3:]]
    points = view.truth.probe_points[::5] * units.length
    return np.concatenate(method.predict(asked)), method.stiffness(points).mean if hasattr(method, "stiffness") else 0.0


@pytest.mark.parametrize("name", METHODS)
def test_a_preset_serves_every_size_of_contact_and_every_scale_of_readings(name, data):
    """A ball of 1/8 on forces of 1/64, as those of a palpation beside those of shoes. Both are powers of two, so that
    nothing is rounded and even a trained network answers alike."""
    here, there = answers(name, data, Units()), answers(name, data, Units(1 / 8, 1 / 64))
    assert np.abs(here[0]).max() > 0.0
    np.testing.assert_allclose(64.0 * there[0], here[0], rtol=1e-6, atol=1e-9 * np.abs(here[0]).max())
    np.testing.assert_allclose(there[1], here[1], rtol=1e-6)


@pytest.mark.parametrize("name", ["gaussian", "near-springs", "cnp"])
def test_what_has_lengths_or_forces_of_its_own_answers_otherwise_without_it(name, data):
    """So that the test above cannot pass for another reason."""
    here = answers(name, data, Units())[0]
    try:
        there = answers(name, data, Units(1 / 8, 1 / 64), made_for=None)[0]
    except MethodError as error:
        assert "the particles are" in str(error)
        return
    assert np.abs(64.0 * there - here).max() > 1e-3 * np.abs(here).max()


def test_factors_come_from_contacts_and_readings_of_training_touches_alone(data):
    train = data[0]
    peak = float(np.median([np.abs(r.value[r.valid]).max() for s in train for r in s.touches]))
    radius = float(np.median([np.sqrt(half_width(r.action.probe) * SurfaceView(s.view).contact(r.action).depth.max())
                              for s in train for r in s.touches]))
    assert Units.of(train, (1.3 * radius, 0.8 * peak)) == Units()  # near what the settings were made for: untouched
    assert Units.of(train, (5.0 * radius, peak / 3.5)) == Units(4.0, 0.25)
    assert Units.of(train, (0.0, 0.0)) == Units.of([], (radius, peak)) == Units()
    silent = [dataclasses.replace(s, touches=tuple(dataclasses.replace(r, value=0.0 * r.value) for r in s.touches))
              for s in train]
    assert Units.of(silent, (2.0 * radius, peak)) == Units(2.0, 1.0)
    unseen = [dataclasses.replace(s, view=dataclasses.replace(s.view, mask=np.zeros_like(s.view.mask))) for s in train]
    assert Units.of(unseen, (2.0 * radius, 2.0 * peak)) == Units(1.0, 2.0)


@pytest.mark.parametrize("probe, larger", [
    (Sphere(0.01), Sphere(0.02)), (Capsule(0.01, 0.02), Capsule(0.02, 0.04)), (Plane(), Plane()),
    (Cylinder(0.01, 0.03), Cylinder(0.02, 0.06)), (Box((0.01, 0.02, 0.03)), Box((0.02, 0.04, 0.06))),
    (Dome(((0.0, 0.0, 0.01), (0.01, 0.0, 0.0), (0.0, 0.01, 0.0)), ((0, 1, 2),)),
     Dome(((0.0, 0.0, 0.02), (0.02, 0.0, 0.0), (0.0, 0.02, 0.0)), ((0, 1, 2),)))])
def test_a_probe_is_enlarged_in_all_its_lengths(probe, larger):
    assert enlarged(probe, 2.0) == larger


def test_what_cannot_be_converted_is_refused(data):
    with pytest.raises(MethodError, match=r"meshfile has one size.*a length of 0"):
        enlarged(MeshFile("tip.stl"), 2.0)
    factory = find_method("near-springs")
    for wrong in ([0.016], [-0.016, 6.0], [0.016, float("inf")]):
        with pytest.raises(MethodError, match="radius"):
            factory(made_for=wrong)
    assert inspect.signature(factory).parameters["made_for"].default is None


def test_a_saved_method_keeps_its_factors(data, tmp_path):
    train, view, readings = data
    first, other = (find_method("near-springs")(made_for=[0.016, 6.0]) for _ in range(2))
    first.meta_fit(train)
    first.save(tmp_path)
    other.load(tmp_path)
    for method in (first, other):
        method.adapt(view.view, readings[:2])
    np.testing.assert_array_equal(other.predict([readings[3].action])[0], first.predict([readings[3].action])[0])
