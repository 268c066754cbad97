"""What has no effect is refused, unless the scene says that it is meant."""

import pytest
import texts

from vsfsim.core.errors import SceneError
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import prepare
from vsfsim.press.command import press

HANDLE = "{shape = {sphere = 0.01}, parts = [{shape = {sphere = 0.005}, offset = [0.0, 0.0, 0.1]}]}"
FAR = "{ shape = { sphere = 0.01 }, pose = [0.3, 0.0, 0.0] }"


def solid(stop=(0.0, 0.0, 0.038), *, allow=(), obstacles="", more="", **keys):
    top = f"allow = {list(allow)}\nobstacles = [{obstacles}]\n{more}\n[object]"
    return texts.scene("block", ("[object]", top), tier='"linear"', press=f"""\
{{ path = [[0.0, 0.0, 0.041], {list(stop)}], frames = 1 }}""", **{"gravity": None, **keys})


def skin(stop, obstacles="", *, start=0.045):
    there = "{ shape = { sphere = 0.01 }, pose = [0.0, 0.0, 0.0] }"
    return texts.scene("bubble", nodes=100, obstacles=f"[{there}, {obstacles}]", press=f"""\
{{ path = [[0.0, 0.0, {start}], [0.0, 0.0, {stop}]], rotation = [3.141592653589793, 0.0, 0.0], frames = 2 }}""")


def balls(*given):
    rows = ", ".join(f"{{ sphere = [{x}, 0.0, 0.015, {r}], value = 1e7 }}" for x, r in given)
    return f"{{ base = 1e5, inclusions = [{rows}] }}"


HALF = "{ base = 1e5, inclusions = [{ box = [-0.03, -0.03, 0.0, 0.03, 0.03, 0.02], value = 200 }] }"


@pytest.mark.parametrize(("word", "said", "made"), [
    ("unused-part", r"inclusions\[0\].*lies outside the body", solid(young_modulus=balls((0.0405, 0.01), (0.0, 0.01)))),
    ("unused-part", r"inclusions\[0\].*lies under later ones", solid(young_modulus=balls((0.0, 0.005), (0.001, 0.01)))),
    ("no-contact", "never brings the probe.* 10 mm away", solid((0.0, 0.0, 0.05))),
    ("no-contact", "never brings the probe", skin(0.05)),
    ("out-of-reach", "obstacle 1 never touches: it stays", solid(obstacles=FAR)),
    ("out-of-reach", "part 1 never touches: it stays", solid(probe=HANDLE)),
    ("out-of-reach", "obstacle 2 never touches: it stays", skin(0.038, FAR)),
    ("own-weight", "young_modulus is 100 Pa.*cannot carry its own weight.*take 294 Pa", solid(young_modulus=100)),
    ("own-weight", "cannot carry its own weight", solid(young_modulus=40, gravity=[0.0, 0.0, -1.62])),
    ("own-weight", "is 200 Pa or less in half of the body", solid(young_modulus=HALF)),
])
def test_what_has_no_effect_is_refused(word, said, made):
    with pytest.raises(SceneError, match=said) as refused:
        press(made)
    assert f'allow = ["{word}"]' in str(refused.value)


@pytest.mark.parametrize("made", [
    solid((0.0, 0.0, 0.05), allow=["no-contact"]),
    solid(allow=["out-of-reach", "unused-part"], obstacles=FAR, young_modulus=balls((0.5, 0.01))),
    solid(gravity=[0.0, 0.0, 0.0], young_modulus=100)], ids=["no-contact", "others", "weightless"])
def test_what_is_meant_is_pressed(made):
    assert press(made).converged


def test_a_dataset_is_refused_too_and_so_is_an_unknown_word(tmp_path, monkeypatch):
    monkeypatch.setattr("vsfsim.physics.linear.rest_factor.RestFactor._solver", property(pytest.fail))
    loaded = solid(young_modulus=balls((0.5, 0.01)), more="touches = { count = 1, depth = 0.003 }")
    with pytest.raises(SceneError, match="lies outside the body"):
        prepare(jobs_of(make_recipe(loaded), loaded.path, tmp_path)[0], device="cpu")
    with pytest.raises(SceneError, match=r"'no-contakt'\. Did you mean 'no-contact'"):
        solid(allow=["no-contakt"])
