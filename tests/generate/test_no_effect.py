"""What has no effect is refused, unless the scene says that it is meant."""

import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import prepare
from vsfsim.press.command import press

SOLID = """
{top}
[object]
shape = {{ box = [0.06, 0.06, 0.03] }}
resolution = 0.03
tier = "linear"
young_modulus = {young}
[probe]
shape = {{ sphere = 0.01 }}
{parts}
[press]
from = {start}
to = {stop}
frames = 1
{more}
"""
SKIN = """
{top}
[sensor]
kind = "bubble"
nodes = 100
[[obstacles]]
shape = {{ sphere = 0.01 }}
pose = [0.0, 0.0, 0.0]
{more}
[press]
path = [{start}, {stop}]
rotation = [3.141592653589793, 0.0, 0.0]
frames = 2
"""
ABOVE, IN, UP = [0.0, 0.0, 0.041], [0.0, 0.0, 0.038], [0.0, 0.0, 0.05]
FAR = "[[obstacles]]\nshape = { sphere = 0.01 }\npose = [0.3, 0.0, 0.0]\n"
HANDLE = "[[probe.parts]]\nshape = { sphere = 0.005 }\noffset = [0.0, 0.0, 0.1]\n"


def scene(text=SOLID, **given):
    values = {"top": "", "young": 1e5, "parts": "", "start": ABOVE, "stop": IN, "more": "", **given}
    return parse_scene(text.format(**values), "s.toml")


def inclusions(*balls):
    rows = ", ".join(f"{{ sphere = [{x}, 0.0, 0.015, {r}], value = 1e7 }}" for x, r in balls)
    return f"{{ base = 1e5, inclusions = [{rows}] }}"


@pytest.mark.parametrize(("word", "said", "made"), [
    ("unused-part", r"inclusions\[0\].*lies outside the body", scene(young=inclusions((0.0405, 0.01), (0.0, 0.01)))),
    ("unused-part", r"inclusions\[0\].*lies under later ones", scene(young=inclusions((0.0, 0.005), (0.001, 0.01)))),
    ("no-contact", "never brings the probe.* 10 mm away", scene(stop=UP)),
    ("no-contact", "never brings the probe", scene(SKIN, start=[0.0, 0.0, 0.045], stop=[0.0, 0.0, 0.05])),
    ("out-of-reach", "obstacle 1 never touches: it stays", scene(more=FAR)),
    ("out-of-reach", "part 1 never touches: it stays", scene(parts=HANDLE)),
    ("out-of-reach", "obstacle 2 never touches: it stays", scene(SKIN, more=FAR, start=[0.0, 0.0, 0.045],
                                                                 stop=[0.0, 0.0, 0.038])),
    ("own-weight", "young_modulus is 100 Pa.*cannot carry its own weight.*take 294 Pa", scene(young=100)),
    ("own-weight", "cannot carry its own weight", scene(young=40, top="gravity = [0.0, 0.0, -1.62]")),
    ("own-weight", "is 200 Pa or less in half of the body", scene(
        young="{ base = 1e5, inclusions = [{ box = [-0.03, -0.03, 0.0, 0.03, 0.03, 0.02], value = 200 }] }")),
])
def test_what_has_no_effect_is_refused(word, said, made):
    with pytest.raises(SceneError, match=said) as refused:
        press(made)
    assert f'allow = ["{word}"]' in str(refused.value)


@pytest.mark.parametrize("made", [
    scene(top='allow = ["no-contact"]', stop=UP),
    scene(top='allow = ["out-of-reach", "unused-part"]', more=FAR, young=inclusions((0.5, 0.01))),
    scene(top="gravity = [0.0, 0.0, 0.0]", young=100)], ids=["no-contact", "others", "weightless"])
def test_what_is_meant_is_pressed(made):
    assert press(made).converged


def test_a_dataset_is_refused_too_and_so_is_an_unknown_word(tmp_path):
    loaded = scene(young=inclusions((0.5, 0.01)), more="[touches]\ncount = 1\ndepth = 0.003\n")
    with pytest.raises(SceneError, match="lies outside the body"):
        prepare(jobs_of(make_recipe(loaded), loaded.path, tmp_path)[0], device="cpu")
    with pytest.raises(SceneError, match=r"'no-contakt'\. Did you mean 'no-contact'"):
        scene(top='allow = ["no-contakt"]')
