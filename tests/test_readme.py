"""What README and CONTRIBUTING show works as it stands there: scenes, the method, commands, paths."""

import re
import sys
import trace
from collections import Counter

import mock_dataset
import pytest
from pages import CONTRIBUTING, README, ROOT, blocks, named
from test_bad_input import run as vsfsim
from texts import scene


def test_the_readme_is_short():
    assert len(README.split()) <= 1200
    for picture in re.findall(r"!\[[^]]+\]\(([^)]+)\)", README):
        assert (ROOT / picture).stat().st_size < 200_000


def test_bibtex_and_citation_file_agree():
    import vsfsim as package

    said = (ROOT / "CITATION.cff").read_text()
    (bibtex,) = blocks(README, "bibtex")
    for cff, tex in (("title", "title"), ("version", "version"), ("license", "license"), ("  - name", "author")):
        (value,) = re.findall(rf"^{cff}: \"?([^\"\n]+)", said, re.MULTILINE)
        assert re.search(rf"{tex} *= {{+{re.escape(value)}}}", bibtex), value
    assert f"version: {package.__version__}\n" in said


def test_the_method_is_found_in_the_current_folder_and_conforms(tmp_path):
    (tmp_path / "mine.py").write_text(named(README, "mine.py", "python"))
    out = vsfsim("check", "mine:OneSpring", cwd=tmp_path)
    assert out.returncode == 0 and "mine:OneSpring conforms" in out.stdout, out.stdout + out.stderr


def test_ci_runs_the_second_command_of_the_readme():
    """The same two steps, in a venv of its own."""
    second = blocks(README, "bash")[0].split("# what the tests need")[1]
    script = (ROOT / ".ci" / "run").read_text()
    for words in ('pip install -c constraints.txt -e ".[test]"', "python -m pytest"):
        assert words in second
    assert '-c constraints.txt -e ".[test]"' in script and '/bin/python" -m pytest' in script


def test_the_container_runs_the_first_command_of_the_readme():
    """All of its steps but the installation, which is the image's."""
    first = blocks(README, "bash")[0].split("# what")[0]
    steps = [line.strip("& \\") for line in first.splitlines() if "vsfsim" in line]
    dockerfile = (ROOT / "Dockerfile").read_text()
    said = dockerfile.split('"-c", "')[1].split('"]')[0].replace("\\\n", " ")
    assert len(steps) == 2 and [one.strip() for one in said.split("&&")] == steps
    assert '-c constraints.txt ".[all,cloud]"' in dockerfile


def test_the_architecture_names_what_is_there():
    """The tree and the way of one touch and of one score: ten steps each, and every path in them exists."""
    chapter = CONTRIBUTING.split("## The architecture")[1].split("\n## ")[0]
    tree = re.findall(r"```\n(.*?)```", chapter, re.DOTALL)[0]
    folders = re.findall(r"^(vsfsim/\w+/)|\s{2}((?:vsfsim/\w+|\w+)/)\s{2}", tree, re.MULTILINE)
    assert {a or b for a, b in folders} >= {f"vsfsim/{p.parent.name}/" for p in ROOT.glob("vsfsim/*/__init__.py")}
    for folder in (a or b for a, b in folders):
        assert (ROOT / folder).is_dir(), folder
    for way in ("The way of one touch", "The way of one score"):
        steps = re.findall(r"^\d+\. .*", chapter.split(way)[1].split("\n\n")[1], re.MULTILINE)
        assert len(steps) == 10 and len(re.findall(r"`[\w/.-]+\.(?:py|toml)`", "\n".join(steps))) >= 10


def test_what_to_read_first_is_most_of_what_runs(tmp_path):
    """Two lists of files in CONTRIBUTING, 20 at most, hold 80 % of the statements of a press and of an evaluation."""
    from vsfsim.bench.evaluate import evaluate
    from vsfsim.bench.task import parse_task
    from vsfsim.press.command import press

    block = scene("block", tier='"fem-coarse"', needs=[])
    task, dataset = parse_task(mock_dataset.TASK, "toy-v1.toml"), mock_dataset.written(tmp_path / "toy")
    work = {"vsfsim/physics/": lambda: press(block),
            "vsfsim/": lambda: evaluate("near-springs", task, dataset, check=False, seeds=1)}
    work["vsfsim/physics/"]()  # makes the kernels
    chapter = CONTRIBUTING.split("**What to read first.**")[1].split("\n**")[0]
    for (folder, run), text in zip(work.items(), chapter.split("At most 20 files hold 80 %")[1:], strict=True):
        tracer = trace.Trace(count=True, trace=False, ignoredirs=[sys.prefix, sys.base_prefix])
        tracer.runfunc(run)
        ran = Counter(name for name, _ in tracer.results().counts if name.startswith(str(ROOT / folder)))
        named = {str(ROOT / path) for path in re.findall(r"`([\w/]+\.py)`", text.split("1. ")[1].split("\n\n")[0])}
        share = sum(ran[name] for name in named) / ran.total()
        assert len(named) <= 20 and share >= 0.8, folder


@pytest.mark.slow
def test_the_refinement_of_the_readme_shows_an_order():
    """Of the plate on a pad: clamped edges are singular, so the order lies below that of the elements."""
    import vsfsim as package

    found = package.press("pad", refine=3)
    (force,) = found.convergence.values()
    print(force.statement)
    assert found.converged and 0.5 < force.order < 4.0
    assert force.error < 0.01 * force.extrapolated and "Observed order of convergence" in found.text()
