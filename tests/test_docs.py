"""Every page: its Python runs, its scenes parse, its commands and links exist, its tables are those of the commands."""

import re
import runpy
import shlex

import pytest
from pages import PAGES, README, ROOT, blocks, loaded

MOCK = """
from mock_dataset import written
written("datasets/try", train=0, test=1, touches=2)
"""
BUBBLE = """
from pathlib import Path
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.run import generate
if __name__ == "__main__":
    generate(load_scene(find_scene("shoes-punyo-mini")), Path("datasets/shoes-punyo-mini-v1"), objects=1, touches=1,
             workers=1)
"""
DATASETS = {"datasets/try": MOCK, "datasets/shoes-punyo-mini-v1": BUBBLE}
"""What a block opens, and the code that makes a small dataset in its place."""

BLOCKS = [(page.name, code) for page in PAGES for code in blocks(page.read_text(), "python")]


def commands(text):
    """Every `vsfsim ...` of the bash blocks, as words."""
    lines = "\n".join(blocks(text, "bash")).replace("\\\n", " ")
    lines = re.sub(r"(vsfsim cluster .*?) (generate|evaluate|papers) ", r"\1 && vsfsim \2 ", lines).splitlines()
    parts = [part.split("#")[0].strip() for line in lines for part in line.split("&&")]
    return [shlex.split(part)[1:] for part in parts if part.startswith("vsfsim ")]


@pytest.mark.parametrize("code", [
    pytest.param(code, id=f"{name}-{k}", marks=[pytest.mark.slow] * ("shoes-punyo" in code))
    for k, (name, code) in enumerate(BLOCKS)])
def test_the_python_blocks_run(code, tmp_path, monkeypatch):
    """As scripts with names of their own, in this process: a new one would import the libraries for seconds."""
    monkeypatch.chdir(tmp_path)
    for part in (*(made for folder, made in DATASETS.items() if folder in code), code):
        (tmp_path / "block.py").write_text(part)
        runpy.run_path("block.py", run_name="__main__")


def test_the_scenes_of_the_pages_parse(tmp_path):
    from vsfsim.core.scene import parse_scene

    scenes = [text for page in PAGES for text in blocks(page.read_text(), "toml") if "[object]" in text]
    assert len(scenes) >= 3
    for text in scenes:
        parse_scene(text, tmp_path / "s.toml").sample(0)
    (slide,) = [text for text in scenes if "obstacles" in text]
    scene = parse_scene(slide, tmp_path / "s.toml").sample(0)
    assert len(scene.bodies) == 3 and scene.frictions == (0.5, 0.5, 0.5) and scene.press.frames == (5, 10)


def test_every_command_and_option_exists():
    """Those of the blocks, and the first words of those that sentences, messages, boards and the list of evidence have.
    Names in capitals are the reader's; options are looked up in the command's own help."""
    from typer.main import get_command

    from vsfsim.cli.main import app
    from vsfsim.core import shelf

    found = [(page.name, words) for page in PAGES for words in commands(page.read_text())]
    assert len(found) > 40
    for where in ("[!C]*.md", "docs/**/*.md", "leaderboard/*.*", "vsfsim/**/*.py", "vsfsim/bench/board/pages/*"):
        found += [(path.name, re.findall("[a-z-]+", said)) for path in ROOT.glob(where) for said in re.findall(
            r'[`:[]"?vsfsim(?: |", ")([a-z][a-z-]*(?:(?: |", ")[a-z][a-z-]*)?)', path.read_text())]
    whole, tasks, methods = get_command(app), shelf.tasks(), shelf.methods()
    for page, given in found:
        command, words = whole, list(given)
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        assert not hasattr(command, "commands") or not words or words[0].startswith("-"), (page, given)
        parameters = {option for p in command.params for option in (*p.opts, *p.secondary_opts)}
        assert {w for w in words if w.startswith("--")} <= parameters | {"--help"}, (page, given)
        for key, shelved in (("--task", tasks), ("--method", methods)):
            if key in words:
                name = re.sub(r"-(development|sealed|seed-\d+)$", "", words[words.index(key) + 1])  # other objects
                assert name in shelved or ":" in name or name.isupper() or name == "NAME-v1", (page, given)


def test_links_and_paths_lead_somewhere():
    for page in PAGES:
        text = page.read_text()
        for target, anchor in re.findall(r"\]\((?!https://)([^)#]*)#?([^)]*)\)", text):
            file = page.parent / target if target else page
            assert file.exists(), (page.name, target)
            names = re.findall(r"^#+ (.*)", file.read_text().lower(), re.MULTILINE) if anchor else []
            anchors = ["-".join(re.sub(r"[^\w -]", "", name).split()) for name in names]
            assert not anchor or anchor in anchors, (page.name, target, anchor)
        for path in re.findall(
                r"`((?:scenes|tasks|tests|docs|vsfsim|baselines|measurements|references)/[\w./-]+)", text):
            made = "NAME" in path or page.name == "CHANGELOG.md"
            assert made or (ROOT / path).exists(), (page.name, path)


def test_the_tests_that_the_pages_name_exist():
    """`file.py::test_name`, `::test_name` of a file named before, `test_name_...` for the beginning of a name."""
    texts = {path.name: path.read_text() for path in (ROOT / "tests").rglob("test_*.py")}
    pattern = r"`(?:[\w/]*/)?(test_\w+\.py)?(?:::)?(?:(test_\w+?)(_\.\.\.)?)?`"
    named = [(page.name, *match) for page in PAGES for match in re.findall(pattern, page.read_text())]
    assert sum(bool(name) for _, _, name, _ in named) > 30
    for page, file, name, dots in named:
        assert not file or file in texts, (page, file)
        end = r"_\w+\(" if dots else r"\("
        assert not name or any(re.search(f"def {name}{end}", text)
                               for text in ([texts[file]] if file else texts.values())), (page, file, name)


def test_the_tiers_and_reasons_of_the_physics_page_are_those_of_the_code():
    from vsfsim.physics.solve.frames import Reason
    from vsfsim.physics.tiers import TIERS

    text = (ROOT / "docs" / "physics.md").read_text()
    tiers = text.split("## Tiers")[1].split("\n\n| tier | element size")[0]
    assert re.findall(r"^\| `([\w-]+)` \|", tiers, re.MULTILINE) == list(TIERS)
    reasons = text.split("| reason | meaning |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", reasons, re.MULTILINE) == [r.name for r in Reason if r.value]


def test_the_leaderboards_of_the_pages_are_those_that_ship():
    """`python docs/make.py results` renews them."""
    module = loaded("make_measured")
    assert module.readme(README) == README and " contact frames of the query touches " in README
    (task,) = re.findall(module.TABLE, README)
    assert (ROOT / "docs" / "pictures" / "board.svg").read_text() == module.charts(task)
    for name, made in module.RESULTS.items():
        assert (module.FOLDER / f"{name}.md").read_text() == made(), name
    written = {path.stem for path in module.FOLDER.glob("*.md")}
    assert written == set(module.MEASURED), "a table that no page includes, or one that was not written"


def test_no_page_calls_a_row_the_lowest():
    """Which row errs least changes with every row, so that a page has it from its table."""
    claim = re.compile(r"\b(?:lowest|smallest|least) (?:errors?|rows?)\b", re.IGNORECASE)
    assert not [(page.name, claim.findall(page.read_text())) for page in PAGES if claim.search(page.read_text())]
    assert "| near-springs (tuned) |" in README, "the tutorial's method is in the README's table"
