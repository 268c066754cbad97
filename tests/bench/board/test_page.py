"""The page of the boards: whole, escaped, and without a script or anything from another machine."""

import dataclasses
from html.parser import HTMLParser

from vsfsim.bench import leaderboard
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
    for words in ("rank corr.", "surface-gp (tuned)", "standard error over objects", "a name of it means"):
        assert words in text, words
