"""What every method does where there is nothing to go on: an answer that is defined, or an error that says what to
do."""

import dataclasses

import numpy as np
import pytest

from vsfsim.bench.check import check, report
from vsfsim.bench.method import build_method, find_method
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import load_task
from vsfsim.core.errors import MethodError, VsfsimError

METHODS = {
    "gaussian": {}, "gaussian-zero": {}, "point-vsf": {}, "dense-vsf": {}, "sbml": {"epochs": 1},
    "imaml": {"epochs": 1, "inner_steps": 2, "cg_steps": 1},
    "imaml-vision": {"epochs": 1, "inner_steps": 2, "cg_steps": 1},
    "grid-vsf": {"iterations": 3, "batch": 100, "samples": 5},
    "neural-vsf": {"iterations": 2, "batch": 100, "samples": 5}, "contact-points": {},
    "near-springs": {}, "surface-gp": {}, "cnp": {"steps": 20, "networks": 1}}
PARTICLES = ("gaussian", "gaussian-zero", "point-vsf", "dense-vsf", "sbml")


@pytest.fixture(scope="module")
def world():
    task = load_task("fewshot-shoes-v3-mini-v1")
    train = [specimen(mock_view(i, split="train", touches=4), task) for i in range(2)]
    view = mock_view(3, touches=6)
    return train, view.view, record(view, task)


def fitted(name, train, **more):
    method = build_method(find_method(name), {**METHODS[name], **more})
    method.meta_fit(train)
    return method


@pytest.fixture(scope="module")
def methods(world):
    """Every method, trained once."""
    return {name: fitted(name, world[0]) for name in METHODS}


@pytest.mark.parametrize(("name", "given"), [*METHODS.items(), ("sbml", {"structure": "HE+SEG", "epochs": 1})])
def test_it_conforms(name, given):
    findings = check(name, parameters=given)
    assert not [f for f in findings if f.outcome == "failed"], report(name, findings)


@pytest.mark.parametrize(("name", "given", "message"), [
    ("imaml", {"features": 3}, "features are '3'"), ("imaml", {"precision": "half"}, "precision is 'half'"),
    ("imaml", {"tasks_per_step": -1}, "tasks_per_step is -1"), ("sbml", {"structure": "HEE"}, "Did you mean 'HE"),
    ("sbml", {"features": "xyzrgbd"}, "Did you mean 'xyzrgb'"), ("sbml", {"networks": 0}, "networks is 0"),
    ("sbml", {"validation": 1.0}, "fraction"), ("neural-vsf", {"octaves": 0}, "octaves 0 must be at least 1"),
    ("contact-points", {"share": 2}, "share is 2"), ("point-vsf", {"estimator": 1}, "batch, filter"),
    ("grid-vsf", {"device": "cuda:0"}, "grid-vsf: device is 'cuda:0', but it runs on the CPU only"),
    ("grid-vsf", {"pose": "register"}, "Did you mean 'registration'"), ("fem-map-seen", {"size": 0.0}, "size is 0")])
def test_a_setting_that_cannot_be_is_refused(name, given, message):
    with pytest.raises(VsfsimError, match=message):
        build_method(find_method(name), given)


@pytest.mark.parametrize(("name", "nothing"), [
    ("gaussian", "prior cannot be estimated"), ("sbml", "no training object"), ("imaml", "none has the two touches")])
def test_what_learns_needs_objects_before_it_answers(name, nothing, world):
    method = build_method(find_method(name), METHODS[name])
    with pytest.raises(MethodError, match=r"meta_fit or load first|has learned nothing yet"):
        method.adapt(world[1], [])
    with pytest.raises(VsfsimError, match=nothing):
        method.meta_fit([])


@pytest.mark.parametrize("name", METHODS)
def test_no_touch_and_silent_touches_have_an_answer(name, world, methods):
    _, view, recording = world
    method = methods[name]
    silent = [dataclasses.replace(r, value=np.zeros_like(r.value)) for r in recording.readings[:3]]
    lost = [dataclasses.replace(r, value=np.full_like(r.value, np.nan), valid=np.zeros_like(r.valid))
            for r in recording.readings[:2]]
    for support in ([], silent, lost):
        method.adapt(view, support)
        assert np.isfinite(method.predict([recording.readings[4].action])[0]).all()
        if hasattr(method, "stiffness"):
            estimate = method.stiffness(np.array([[0.0, 0.0, 0.028]]))
            assert np.isfinite(estimate.mean).all() and (estimate.mean >= 0.0).all()
    broken = dataclasses.replace(recording.readings[0], value=np.full_like(recording.readings[0].value, np.nan))
    with pytest.raises(MethodError, match="not finite"):
        method.adapt(view, [broken])
    if name in PARTICLES:
        # Zero force under a moved particle is a reading, too: it is soft there.
        method.adapt(view, [])
        before = method.predict([recording.readings[0].action])[0].max()
        method.adapt(view, silent)
        assert method.predict([recording.readings[0].action])[0].max() <= before


@pytest.mark.parametrize("name", PARTICLES)
def test_an_object_of_one_particle(name, world):
    train, view, recording = world
    method = fitted(name, train)
    model = method.shelf.get(view)
    model.particles = model.particles[np.argmin(np.linalg.norm(model.particles - [0.0, 0.0, 0.03], axis=1))][None]
    for kept in (model.rows, model.features, getattr(method, "_priors", {})):
        kept.clear()  # mock objects look alike: the training objects were this model, too
    method.adapt(view, [])
    before = method.predict([recording.readings[4].action])[0]
    method.adapt(view, recording.readings[:3])
    after = method.predict([recording.readings[4].action])[0]
    assert method.posterior.stiffness.shape == (1,) and np.isfinite(after).all() and (after >= before - 1e-9).all()
    assert np.isfinite(method.stiffness(np.zeros((2, 3))).mean).all()


@pytest.mark.parametrize("name", ["neural-vsf", "grid-vsf"])
def test_a_field_needs_forces_with_and_without_touches(name, world, methods):
    _, view, recording = world
    method = methods[name]
    strange = dataclasses.replace(recording.readings[0].action, observation="temperature")
    for support in ([], recording.readings[:2]):
        method.adapt(view, support)
        with pytest.raises(MethodError, match="needs 'normal-force'"):
            method.predict([strange])


def test_contact_points_are_of_forces(world, methods):
    _, view, recording = world
    method = methods["contact-points"]
    method.adapt(view, [dataclasses.replace(r, action=dataclasses.replace(r.action, observation="temperature"))
                        for r in recording.readings[:3]])
    with pytest.raises(MethodError, match="readings are 'temperature'"):
        method.locate(np.eye(3), np.array([[0, 1, 2]]))


@pytest.mark.parametrize("name", METHODS)
def test_a_view_that_shows_nothing_is_refused(name, world, methods):
    _, view, recording = world
    method = methods[name]
    empty = dataclasses.replace(view, mask=np.zeros_like(view.mask))
    hole = dataclasses.replace(view, depth=np.where(np.arange(view.depth.shape[1]) % 7 == 0, 0.0,
                                                    view.depth).astype(view.depth.dtype))
    blind = name in ("imaml", "contact-points")  # they predict forces without looking
    for broken, words in ((empty, "mask is empty"), (hole, "depth is 0 or not a number")):
        if blind or (name == "imaml-vision" and broken is hole):
            method.adapt(broken, recording.readings[:2])
            assert np.isfinite(method.predict([recording.readings[4].action])[0]).all()
        else:
            with pytest.raises(VsfsimError, match=words):
                method.adapt(broken, recording.readings[:2])
        if name == "contact-points":
            with pytest.raises(MethodError, match=words):
                method.locate(np.eye(3), np.array([[0, 1, 2]]))


@pytest.mark.parametrize("name", ["sbml", "imaml-vision"])
def test_missing_features_say_how_to_get_them(name, world, tmp_path, monkeypatch):
    monkeypatch.setenv("VSFSIM_DINOV2", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(VsfsimError, match="curl"):
        fitted(name, world[0], features="dinov2-s")
