"""`vsfsim check` passes what conforms and names the clause that a method breaks."""

import numpy as np
import pytest

from vsfsim.bench.check import check, report
from vsfsim.bench.mock import BALL, displacement, mock_view
from vsfsim.core.errors import MethodError


def failed(name):
    return [f.clause for f in check(name) if f.outcome == "failed"]


def test_a_conforming_method_passes():
    findings = check("toy_methods:Constant")
    assert [f for f in findings if f.outcome == "failed"] == [], report("c", findings)
    assert "conforms" in report("c", findings)


def test_optional_functions_are_optional():
    findings = {f.clause: f.outcome for f in check("toy_methods:Oracle")}
    assert findings["what it learned can be handed to a trial"] == "ok"
    assert findings["stiffness is finite and not negative"] == "not offered"


@pytest.mark.parametrize(("name", "clause"), [
    ("Cumulative", "adapt forgets the object before"),
    ("Random", "is deterministic"),
    ("SwallowsNan", "refuses a reading that is not a number"),
    ("Flat", "predicts before any touch (0-shot)"),
    ("Mutates", "leaves its input alone"),
    ("Negative", "stiffness is finite and not negative"),
    ("NegativeStd", "predict_std is finite and not negative"),
    ("AnswersNan", "adapts to touches and predicts (5-shot)"),
])
def test_a_broken_clause_is_named(name, clause):
    found = failed(f"toy_methods:{name}")
    assert clause in found
    assert found == [clause] or name not in ("SwallowsNan", "Negative", "NegativeStd", "Mutates")


def test_a_method_without_a_required_function_is_refused():
    with pytest.raises(MethodError, match="NoPredict has no function predict"):
        check("toy_methods:NoPredict")
    with pytest.raises(MethodError, match="has no class '__name__'"):
        check("toy_methods:__name__")


def test_the_forces_of_a_mock_touch_are_those_of_its_springs():
    """Each particle within the ball goes to the nearest point of its surface, the others stay; the half x > 0 is five
    times as stiff."""
    truth, touch = mock_view(0).truth, mock_view(0).touches[0]
    for centre, force in zip(touch.mount_pose[:, :3, 3], touch.force, strict=True):
        way = displacement(truth.points, centre)
        far = np.linalg.norm(truth.points - centre, axis=1).clip(BALL.radius)
        assert np.linalg.norm(truth.points + way - centre, axis=1) == pytest.approx(far, abs=1e-12)
        assert force == pytest.approx(-truth.vsf_stiffness @ way, abs=1e-12)
    soft, stiff = (truth.vsf_stiffness[truth.region == k].mean() for k in (0, 1))
    assert stiff / soft == pytest.approx(5.0, rel=0.05)
