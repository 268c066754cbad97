"""The leaderboard's pages: whole, escaped, offline, and opened by a browser."""

import base64
import dataclasses
import hashlib
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.board.site import write_site
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.mock import mock_view
from vsfsim.bench.task import load_task, parse_task

EVIL = "<script>document.title='taken'</script>\"'&\u202ename"
VOID = {"meta", "br"}


class Page(HTMLParser):
    """Checks that tags are closed in their order, and keeps links and texts."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.tags, self.words = [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ("href", "src")]
        assert not [key for key, _ in attrs if key.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def site(folded_text, write_dataset, tmp_path_factory):
    """Pages of one task with two methods, one of which has a hostile name."""
    text = folded_text.replace("draws = 2, trainings = 2", "draws = 1, trainings = 1")
    task = parse_task(text.replace('method = "somebody"', 'method = "prior (zero)"'), "toy-v1.toml")
    folder, dataset = tmp_path_factory.mktemp("site"), write_dataset([mock_view(i, touches=12) for i in range(4)])
    result = evaluate("toy_methods:Sure", task, dataset, parameters={"value": 2.0}, check=False)
    (folder / "results").mkdir()
    result.save(folder / "results" / "a.json")
    queries = {**result.queries, "sse": [1.2**2 * v for v in result.queries["sse"]],
               "sae": [1.2 * v for v in result.queries["sae"]]}
    worse = dataclasses.replace(result, method=EVIL, entry=EVIL, notes=(EVIL,), parameters={EVIL: EVIL},
                                queries=queries)
    dataclasses.replace(worse, scores=worse.computed()).save(folder / "results" / "b.json")
    board = leaderboard.collect(task, [folder / "results"])
    return board, write_site([board], folder / "out")


def runs_its_script(page):
    """Whether the page's policy allows the script in it, by its digest, and no other."""
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return re.search(r"script-src ([^;\"]+)", page)[1] == f"'sha256-{digest}'"


def test_every_page_is_whole_and_every_link_leads_to_a_page(site):
    board, files = site
    assert len(files) == 1 + 1 + 2  # the index, a task, its methods
    names = {path.name for path in files}
    for path in files:
        found = Page(path.read_text())
        assert names.issuperset(found.links), path.name
        assert found.tags.count("script") == 1 and runs_its_script(path.read_text()), path.name
        assert "://" not in path.read_text(), "nothing from another machine"
    text = " ".join(Page(next(p for p in files if p.name.startswith("task-")).read_text()).words)
    for words in ("rank", "meta-fit", "Error over touches", "standard error over objects", "(0.50)", "mock-0003"):
        assert words in text, words
    assert [row.rank for row in board.rows] == [1, None], "a name that a shell would take for more is not ranked"


def test_names_of_strangers_are_text(site):
    for path in site[1]:
        assert path.read_text().count("<script") == 1 and "\u202e" not in path.read_text()
    pages = " ".join(path.read_text() for path in site[1])
    assert "&lt;script&gt;" in pages


def test_a_task_of_masks_is_compared_by_its_own_metric_and_not_by_the_error_of_readings(tmp_path, monkeypatch):
    entry = SimpleNamespace(evidence="open", other_bits=False)
    monkeypatch.setattr(leaderboard, "listed", lambda: SimpleNamespace(get=lambda _: entry))
    board = leaderboard.collect(load_task("rope-punyo-mini-v2"))
    neural, grid = (next(row for row in board.rows if row.result.method == name) for name in ("neural-vsf", "grid-vsf"))
    found = {row.result.method: row.scores["mask_f1"]["all"].mean for row in (neural, grid)}
    assert np.mean(list(neural.objects["all"].values())) == pytest.approx(found["neural-vsf"])
    pages = {path.name: " ".join(Page(path.read_text()).words) for path in write_site([board], tmp_path)}
    page = pages["task-rope-punyo-mini-v2.html"]
    assert f"{found['grid-vsf'] - found['neural-vsf']:+.3f} ±" in page, "the difference is one of F1 scores"
    assert "Score over touches" in page and not any("error over that of" in words for words in pages.values())
    number, best = next((k, row.objects["all"]) for k, row in enumerate(board.rows) if row.result.method == "grid-vsf")
    order = re.findall(r"rope-punyo-mini-\d{4}", pages[f"method-rope-punyo-mini-v2-{number}.html"])
    assert order[0] == max(best, key=best.get), "the object with the highest F1 comes first"
