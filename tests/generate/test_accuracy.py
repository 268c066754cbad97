"""`vsfsim generate --accuracy`: what is chosen and kept, audited, verified, refused."""

import itertools
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from vsfsim.cli.main import app
from vsfsim.cli.simulate import _kept
from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.disk import Store
from vsfsim.data.manifest import ENOUGH, RISK, apart, audit_error, error_against, observed, verdict
from vsfsim.data.verify import verify
from vsfsim.generate import run
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.trade import buy
from vsfsim.generate.trade.setting import Setting


@pytest.fixture
def scene(loaded):
    return loaded("small")


def test_the_least_factor_keeps_every_setting_that_breaks_it_from_being_taken():
    """Of settings with these differences and errors; a larger factor goes further and breaks nothing."""
    differences, errors = [0.02, 0.01, 0.004], [0.06, 0.03, 0.01]
    for asked, first in ((0.05, 1), (0.02, 2), (0.1, 0)):
        factor = buy.least_factor(differences, errors, asked)
        ends = [buy.ended(differences, factor * more, asked) for more in (1.0, 1.5, 100.0)]
        assert all(errors[k] <= asked for k in ends) and ends[0] == first and ends == sorted(ends)
        if factor > 0.0:
            assert errors[buy.ended(differences, 0.999 * factor, asked)] > asked
    assert buy.least_factor(differences, errors, 0.005) == np.inf
    assert buy.least_factor([np.inf, 0.01], [np.inf, 0.01], 0.02) <= 1.0 + 1e-6  # a lost frame always goes on
    one, less = (SimpleNamespace(force=np.full((1, 3), f), converged=np.ones(1, bool)) for f in (1.0, 0.01))
    assert apart(one, one) == np.inf and apart(less, less) == 0.0  # of one mesh; below the noise


def test_the_largest_of_a_pilot_bounds_enough_of_all():
    """In 95 % of pilots; no number smaller than `PILOT` does."""
    assert ENOUGH**buy.PILOT <= RISK < ENOUGH ** (buy.PILOT - 1)
    shares = np.random.default_rng(0).uniform(size=(4000, buy.PILOT)).max(axis=1)  # under the largest, of uniform ones
    assert np.mean(shares >= 0.95) == pytest.approx(0.95, abs=0.01)


GROUND = Setting("fem-coarse", 0.0099, nodes=390)


def test_a_touch_that_loses_a_frame_goes_on_whatever_the_factor():
    """And one that loses none ends under the second setting; the factor is 0, with which all of a pilot were kept."""
    force, steps = np.array([[0.0, 0.0, 1.0]]), GROUND.steps()

    def touched(subject, aims, setting, *, device):
        here = steps.index(setting)
        return [SimpleNamespace(force=force * here, converged=np.array([a == "whole" or here != 1]), made=setting)
                for a in aims]

    recipe = SimpleNamespace(objects=1, views=1)
    subject = SimpleNamespace(job=SimpleNamespace(recipe=recipe, object_index=0, view_index=0, stream=lambda kind: 0))
    promise = {"asked": 0.05, "factor": 0.0, "audits": 0, "steps": [s.table() for s in steps], "ladder": []}
    made = OnSolids._promised(SimpleNamespace(touched=touched), subject, ["whole", "lost"], promise, device="cpu")
    assert [steps.index(one.made) for one in made] == [1, 3]


def touches(scene, ground, asked, request, store):
    """Touches that imagined settings are off by 300 h^2 (8 % to 20 mm, 0.6 % to the finest), each 1 s dear."""
    fine = [step.resolution * (1.0 if step.level is None else 0.5 / 1.3**step.level) for step in ground.steps()]
    force, found = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0]]), np.ones(2, bool)
    made = [SimpleNamespace(force=force * (1.0 + 300.0 * edge**2), converged=found) for edge in fine]
    errors = [error_against(one.force, found, force, found) for one in made]
    one = buy.Tried([apart(*pair) for pair in itertools.pairwise(made)], errors, [1.0] * 5)
    return [(k, one) for k in range(request.objects)]


def test_a_pilot_chooses_a_factor_once_or_refuses_with_the_figure(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(buy, "touches", touches)
    recipe, said = make_recipe(scene), []
    tier, options = buy.bought(scene, tmp_path / "new", Request(accuracy=0.13, note=said.append), recipe)
    promise = options["accuracy"]
    # 300 h^2 is 12 % at 20 mm; at 26 mm it is 20 %, 11.6 % of the force there less than at 34 mm
    assert tier == "fem-coarse" and promise["factor"] == pytest.approx(0.13 / 0.1163, 1e-3)
    assert promise["expected"] == pytest.approx(0.12)
    assert "a pilot of 59 touches of different objects" in said[0]
    assert "59 of 59 end under fem-coarse, 20 mm" in said[1] and "4 touches cost about 12 s" in said[1]
    with pytest.raises(SceneError, match=r"59 of 59 touches .* more under .*, the worst by 0.62 %"):
        buy.bought(scene, tmp_path / "new", Request(accuracy=0.005), recipe)


def test_a_pilot_that_is_interrupted_goes_on(scene, tmp_path, monkeypatch):
    asked, made = Request(objects=buy.PILOT, seed=5), []

    def in_pool(function, jobs, *_, **__):
        for job in jobs:
            made.append(job.object_index)
            if len(made) == 8:
                raise KeyboardInterrupt
            yield job, buy.Tried([np.inf, 0.1], [np.inf, 0.2, 0.1], [1.0] * 4)

    monkeypatch.setattr(buy, "in_pool", in_pool)
    store = Store(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        list(buy.touches(scene, GROUND, 0.05, asked, store))
    assert _kept(tmp_path).startswith("interrupted; 7 touches of the pilot are kept")
    one = buy.Tried([np.inf, 0.1], [np.inf, 0.2, 0.1], [1.0] * 4)
    assert list(buy.touches(scene, GROUND, 0.05, asked, store)) == [(k, one) for k in range(59)]
    assert made == [*range(8), *range(7, 59)]
    assert list(buy.touches(scene, GROUND, 0.2, asked.but(objects=9), store)) == [(k, one) for k in range(9)]
    assert len(made) == 60
    assert len(list(buy.touches(scene, GROUND, 0.05, asked.but(seed=6), store))) == 59 and len(made) == 60 + 59


@pytest.mark.parametrize(("given", "said"), [("0", "may be 0.1 % to 50 %"), ("300%", "is 300 %"), ("5", "is 500 %"),
                                             ("much", "give a share, e.g. 5% or 0.05")])
def test_accuracies_that_nobody_can_keep_are_refused(given, said):
    run = CliRunner().invoke(app, ["generate", "shoes-mini", "--accuracy", given])
    assert isinstance(run.exception, VsfsimError) and said in str(run.exception)


def test_what_has_no_accuracy_is_refused(tmp_path):
    with pytest.raises(VsfsimError, match="--tier is 'fem' and --accuracy is 5 %"):
        run.planned("shoes-mini", tmp_path / "a", accuracy=0.05, tier="fem")
    assert not (tmp_path / "a").exists()
    assert str(run.planned("shoes-mini", accuracy=0.05).folder).endswith("-accuracy-5")


@pytest.mark.parametrize(("kept", "audits", "word"), [
    (29, 29, "kept: 29 of 29"), (28, 28, "cannot tell yet: .* 29 audits are needed"), (0, 0, "cannot tell yet"),
    (28, 29, "46 audits are needed"), (45, 46, "kept"), (9, 10, "cannot tell yet"), (5, 10, "broken: .*, under 95 %"),
    (93, 100, "cannot tell"), (89, 100, "broken")])
def test_a_verdict_has_an_exact_bound(kept, audits, word):
    """45 of 46: P(45 or 46 of 46 | 0.9) = 0.048; 89 of 100: P(89 or fewer | 0.95) = 0.011."""
    found = observed({"accuracy": {"asked": 0.05, "factor": 1.0, "expected": 0.02}},
                     [0.01] * kept + [0.08] * (audits - kept))
    said, refuted = verdict(found)
    assert re.match(word if ":" in word else f".*{word}", said) and refuted == said.startswith("broken")
    assert observed({}, [0.1]) is None


@pytest.mark.parametrize(("off", "unsure", "lost", "error"), [
    ([0.09] * 3, 0.0, [], 0.09), ([0.0, 0.09, 0.0], 0.0, [], 0.09), ([0.0] * 3, 0.9, [], 0.09),
    ([0.0] * 3, 0.0, [1], np.inf)])
def test_the_error_of_a_touch_is_that_of_its_worst_reading(off, unsure, lost, error):
    wanted, good = np.outer([0.1, 1.0, 10.0], [0.0, 0.0, 1.0]), np.ones(3, bool)
    force, found = wanted * (1.0 + np.array(off))[:, None], ~np.isin(range(3), lost)
    for pair in ((found, good), (good, found)):
        assert error_against(force, pair[0], wanted, pair[1], np.array([0.0, 0.0, unsure])) == pytest.approx(error)
    assert error_against(0.1 * force[:2], good[:2], 0.1 * wanted[:2], good[:2]) is None, "too quiet"


@pytest.mark.slow
def test_a_dataset_holds_its_audits_and_verify_holds_it_to_them(scene, tmp_path, here, monkeypatch):
    monkeypatch.setattr(buy, "touches", touches)
    monkeypatch.setattr(buy, "AUDITS", (1, 1))
    made = run.generate(scene, tmp_path / "data", accuracy=0.5, objects=1)
    monkeypatch.setattr(buy, "touches", None)  # a second pilot would fail
    run.generate(scene, tmp_path / "data", accuracy=0.5, objects=1)
    stored = json.loads((tmp_path / "data" / "dataset.json").read_text())
    assert stored["accuracy"]["asked"] == 0.5
    report = verify(tmp_path / "data")
    audited = [t for t in made[0].touches if "reference_force" in t.audit]
    assert report.ok and "audits are needed" in report.text() and len(audited) == 1
    off = np.linalg.norm(audited[0].force - audited[0].audit["reference_force"], axis=1)
    on = np.linalg.norm(audited[0].audit["reference_force"], axis=1) > 0.15
    assert audit_error(audited[0]) >= (off[on] / np.linalg.norm(audited[0].force, axis=1)[on]).max() * 0.9
    truth = made[0].truth
    assert truth.probe_error.shape == truth.probe_stiffness.shape and "probe_stiffness is known to" in report.text()
