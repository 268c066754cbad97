"""Answers that were kept belong to the method's source and to the files that it names."""

import dataclasses

import pytest
import toy_methods  # noqa: F401  (the methods below extend one of it, in a process of their own)

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.core.errors import MethodError

METHOD = """
from toy_methods import Constant
{imports}

class Mine(Constant):
    def __init__(self, *, seed=0, weights=""):
        super().__init__(value={value})
        if weights:
            self.value = float(open(weights).read())
        self.seed = seed

    def adapt(self, view, support):
        if self.seed == {crash}:
            raise RuntimeError("a bug")
        super().adapt(view, support)
"""


@pytest.fixture
def author(tmp_path, monkeypatch, task, toy_dataset):
    """Writes a method and evaluates it with what was kept before."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "helper.py").write_text("VALUE = 5.0\n")

    def run(value="5.6", crash="None", imports="", **parameters):
        (tmp_path / "mine.py").write_text(METHOD.format(value=value, crash=crash, imports=imports))
        return evaluate("mine:Mine", task, toy_dataset, check=False, part=tmp_path / "part", parameters=parameters,
                        isolation=Isolation("process"))

    return run


def levels(result, task):
    """What was answered in each seed, from the largest errors: the truth is the same in every seed."""
    return [round(v, 9) for v in result.scores["rmse"]["0"].per_seed]


def test_a_mended_method_begins_again_and_says_so(author, task, tmp_path):
    with pytest.raises(MethodError, match="a bug"):
        author(crash="2")
    assert len(list((tmp_path / "part").glob("*.npz"))) == 2
    mended = author(value="8.0")
    assert len(set(levels(mended, task))) == 1, "all seeds are of the mended method"
    assert mended.notes == (f"2 finished seeds of an earlier run are not used, because the method has another content "
                            f"({mended.notes[0].partition('(')[2]}",)


def test_the_same_method_goes_on(author, tmp_path):
    with pytest.raises(MethodError):
        author(crash="2")
    before = (tmp_path / "part" / "seed-0000.npz").stat().st_mtime_ns
    with pytest.raises(MethodError):
        author(crash="2")
    assert (tmp_path / "part" / "seed-0000.npz").stat().st_mtime_ns == before


@pytest.mark.parametrize("what", ["helper", "weights"])
def test_a_file_that_the_method_imports_or_is_given_counts(author, task, tmp_path, what):
    (tmp_path / "w.txt").write_text("5.0")
    given = {"weights": str(tmp_path / "w.txt")} if what == "weights" else {}
    words = {"value": "helper.VALUE", "imports": "import helper"} if what == "helper" else {}
    with pytest.raises(MethodError):
        author(crash="2", **words, **given)
    source = (tmp_path / "mine.py").read_text()
    (tmp_path / ("helper.py" if what == "helper" else "w.txt")).write_text("VALUE = 8.0\n" if what == "helper" else "8")
    with pytest.raises(MethodError, match="a bug"):
        author(crash="2", **words, **given)
    assert (tmp_path / "mine.py").read_text() == source
    first = (tmp_path / "part" / "seed-0000.npz").stat().st_mtime_ns
    (tmp_path / ("helper.py" if what == "helper" else "w.txt")).write_text("VALUE = 9.0\n" if what == "helper" else "9")
    with pytest.raises(MethodError):
        author(crash="2", **words, **given)
    assert (tmp_path / "part" / "seed-0000.npz").stat().st_mtime_ns != first


def test_a_result_says_what_decided_it(author, tmp_path):
    (tmp_path / "w.txt").write_text("5.0")
    found = author(weights=str(tmp_path / "w.txt"))
    assert set(found.contents) == {"the method", "the harness", str(tmp_path / "w.txt")}
    found.save(tmp_path / "r.json")
    again = type(found).load(tmp_path / "r.json")
    assert again.contents == found.contents
    assert dataclasses.asdict(again)["contents"] == dict(found.contents)
