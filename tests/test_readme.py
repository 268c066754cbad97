"""What the README shows works as it stands there: its scene, its method, its commands."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def named(name, language):
    """The block whose first line is a comment with this file name."""
    (block,) = [b for b in blocks(README, language) if b.startswith(f"# {name}:")]
    return block


def vsfsim(*words, cwd):
    return subprocess.run([sys.executable, "-P", "-c", "from vsfsim.cli.main import main; main()", *words],
                          capture_output=True, text=True, cwd=cwd)


def commands():
    """Every `vsfsim ...` of both pages, as words."""
    text = "\n".join(blocks(README, "bash") + blocks(CONTRIBUTING, "bash")).replace("\\\n", " ")
    parts = [part.split("#")[0].strip() for line in text.splitlines() for part in line.split("&&")]
    return [shlex.split(part)[1:] for part in parts if part.startswith("vsfsim ")]


def test_the_method_conforms(tmp_path):
    (tmp_path / "mine.py").write_text(named("mine.py", "python"))
    out = vsfsim("check", "mine:OneSpring", cwd=tmp_path)
    assert out.returncode == 0 and "mine:OneSpring conforms" in out.stdout, out.stdout + out.stderr


def test_the_scene_can_be_sampled_and_its_scan_variant_too(tmp_path):
    from vsfsim.core.scene import parse_scene

    text = named("foam.toml", "toml")
    assert parse_scene(text, tmp_path / "foam.toml").sample(0).press.frames == (5,)
    scan = re.sub(r"box = \[[^]]*\]", 'mesh = "scan.obj"', text)
    assert parse_scene(scan, tmp_path / "foam.toml").sample(0).object.shape.path.endswith("scan.obj")


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_every_command_and_option_exists(words):
    """Names in capitals are the reader's; options are looked up in the command's own help."""
    from typer.main import get_command

    from vsfsim.cli.main import app
    from vsfsim.core import shelf

    parameters = {option for p in get_command(app).commands[words[0]].params for option in p.opts}
    assert {w for w in words[1:] if w.startswith("--")} <= parameters | {"--help"}
    for key, shelved in (("--task", shelf.tasks()), ("--method", shelf.methods())):
        if key in words:
            name = words[words.index(key) + 1]
            assert name in shelved or ":" in name or name.isupper() or name == "NAME-v1"


def test_links_lead_somewhere():
    for page in (README, CONTRIBUTING):
        for target in re.findall(r"\]\(([^)#]+)\)", page):
            assert (ROOT / target).exists(), target
        for path in re.findall(r"`((?:scenes|tasks|tests|docs|vsfsim)/[\w./-]+)`", page):
            assert (ROOT / path).exists() or path.endswith(("NAME.py", "NAME.toml", "NAME-v1.toml")), path


@pytest.mark.parametrize("page", sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]), ids=lambda page: page.name)
def test_no_page_has_a_conflict_left_by_a_merge(page):
    assert not re.findall(r"^(?:<{7}|={7}$|>{7}).*", page.read_text(), re.MULTILINE)


def test_the_tiers_of_the_readme_are_those_of_the_code():
    from vsfsim.physics.tiers import TIERS

    table = README.split("## Fidelity")[1].split("##")[0]
    assert re.findall(r"^\| `([\w-]+)` \|", table, re.MULTILINE) == list(TIERS)


def test_the_example_of_bodies_and_paths_is_a_scene(tmp_path):
    from vsfsim.core.scene import parse_scene

    (block,) = [b for b in blocks(README, "toml") if "obstacles" in b]
    text = block.replace("[object]",
                         "[object]\nshape = "
                         "{ box = [0.1, 0.1, 0.05] }\nyoung_modulus = 1e5").replace("[[probe.parts]]",
                                                                                    "[probe]\nshape = "
                                                                                    "{ sphere = 0.02 }\n[[probe.parts]]")
    scene = parse_scene(text, tmp_path / "s.toml").sample(0)
    assert len(scene.bodies) == 3 and scene.frictions == (0.5, 0.5, 0.5) and scene.press.frames == (5, 10)


def test_the_entry_point_example_is_valid_toml():
    (block,) = [b for b in blocks(README, "toml") if "entry-points" in b]
    assert tomllib.loads(block)["project"]["entry-points"]["vsfsim.methods"] == {"one-spring": "mine:OneSpring"}


def test_ci_runs_the_second_command_of_the_readme():
    """The same two steps, in a venv of its own."""
    second = blocks(README, "bash")[1]
    script = (ROOT / ".ci" / "run").read_text()
    for words in ('pip install -c constraints.txt -e ".[test]"', "python -m pytest"):
        assert words in second
    assert '-c constraints.txt -e ".[test]"' in script and '/bin/python" -m pytest' in script
