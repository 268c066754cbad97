"""The page of the boards: whole, escaped, and without a script or anything from another machine."""

import dataclasses
import re
from html.parser import HTMLParser

import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.board.templates import filled
from vsfsim.bench.task import load_task

EVIL = "<script>document.title='taken'</script>\"'&\u202ename"
VOID = {"meta", "br"}


class Page(HTMLParser):
    """Checks that tags are closed in their order, and keeps them and the links."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.places, self.tags = [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ("href", "src")]
        self.places += [f"#{value}" for key, value in attrs if key == "id"]
        assert not [key for key, _ in attrs if key.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_names_of_strangers_are_text(constant, task, tmp_path):
    result = dataclasses.replace(constant(2.0), method=EVIL, entry=EVIL)
    result.save(tmp_path / "a.json")
    boards = [leaderboard.collect(task, [tmp_path]), leaderboard.collect(load_task("fewshot-shoes-v3-mini-v1"))]
    text = leaderboard.page(boards)
    page = Page(text)
    assert set(page.links) == set(page.places) == {"#toy-v1", "#fewshot-shoes-v3-mini-v1"}
    assert "script" not in page.tags and "&lt;script&gt;" in text and "\u202e" not in text and "://" not in text
    for words in ("rank corr.", "surface-gp (tuned)", "standard error over objects", "a name of it is empty"):
        assert words in text, words


@pytest.mark.parametrize("name", ["fewshot-shoes-v3-mini-v1", "real-palpation-v1", "inclusion-mini-v3"])
def test_the_chart_has_each_method_once_and_its_errors_where_the_axis_has_them(name):
    """On real presses a row errs by more than the axis shows: it is written there."""
    board = leaderboard.collect(load_task(name))
    found, methods = leaderboard.chart(board), {row.result.method for row in board.rows if row.rank}
    svg = filled("chart.svg", chart=found, alone=True)
    assert f'aria-label="Rank 1 of {len(methods)} methods: {board.rows[0].result.method}' in svg
    assert all(svg.count(f">{one}</text>") == 1 for one in methods)
    (zero,), (one,) = (re.findall(rf'<text x="([\d.]+)" y="[\d.]+" text-anchor="middle">{k}<', svg) for k in "01")
    drawn = [float(x) for x in re.findall(r'<circle cx="([\d.]+)" cy="[\d.]+" r="4.5" fill="var\(--link', svg)]
    values = [value for line in found["lines"] for value in line["at"]]
    expected = [float(zero) + value * (float(one) - float(zero)) for value in values if value <= 1.1]
    assert drawn[len(board.task.protocol.labels):] == pytest.approx(expected, abs=0.2)
    beyond = sorted(value for value in values if value > 1.1)[-1:]
    assert re.findall("([\\d.]+) \u25b8", svg) == [f"{value:.2f}" for value in beyond]
    assert leaderboard.chart(dataclasses.replace(board, rows=())) == {}
