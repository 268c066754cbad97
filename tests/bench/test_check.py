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
    view = mock_view(0)
    points, spring = view.truth.points, view.truth.vsf_stiffness
    for touch in view.touches:
        centres = touch.probe_pose()[:, :3, 3]
        far = np.linalg.norm(points - centres[:, None], axis=2)
        moved = np.stack([points + displacement(points, centre) for centre in centres])
        after = np.linalg.norm(moved - centres[:, None], axis=2)
        assert after == pytest.approx(np.maximum(far, BALL.radius), abs=1e-12)
        assert touch.force == pytest.approx(-np.einsum("n,tnk->tk", spring, moved - points), abs=1e-12)
        assert touch.touched == (far < BALL.radius).any()
    stiff = view.truth.region == 1
    assert spring[stiff].mean() / spring[~stiff].mean() == pytest.approx(5.0, rel=0.05)
