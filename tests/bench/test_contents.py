"""What a score is of: kept answers and digests belong to the method's source, the files that it opens, and the parts of
vsfsim that its answers pass through."""

import os

import pytest
import toy_methods  # noqa: F401  (the methods below extend one of it, in a process of their own)

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.identity import _SCORES, contents_of, files_of, method_sha256
from vsfsim.bench.isolation.limits import works
from vsfsim.core.errors import MethodError

KEPT = "r.parts/*/*.answers"
METHOD = """
import os
from toy_methods import Constant

class Mine(Constant):
    def __init__(self, *, seed=0, weights=""):
        super().__init__(value={value})
        if weights:
            self.value = float(open(weights).read())
        self.seed = seed

    def meta_fit(self, specimens):
        {learns}

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
    (tmp_path / "table.csv").write_text("5.0")

    def run(value="5.6", crash="None", learns="pass", progress=lambda *_: None, seeds=1, **parameters):
        (tmp_path / "mine.py").write_text(METHOD.format(value=value, crash=crash, learns=learns))
        return evaluate("mine:Mine", task, toy_dataset, out=tmp_path / "r.json", check=False,
                        seeds=seeds, parameters=parameters, sandbox="process", progress=progress)

    return run


def test_a_mended_method_begins_again(author, tmp_path):
    with pytest.raises(MethodError, match="a bug"):
        author(crash="1", seeds=2)
    assert len(list(tmp_path.glob(KEPT))) == 1
    mended = author(value="8.0", seeds=2)
    assert len({round(v, 9) for v in mended.scores["rmse"]["0"].per_seed}) == 1, "all seeds are of the mended method"


@pytest.mark.parametrize(("file", "words"), [
    ("mine.py", {}), ("w.txt", {"weights": "w.txt"}),
    ("helper.py", {"learns": "import sys, importlib as i; sys.path.append({here!r}); i.import_module('help' + 'er')"}),
    ("table.csv", {"learns": "self.value = float(open({here!r} + '/table.csv').read())"}),
    ("table.csv", {"learns": "self.value = float(open(os.fsencode({here!r} + '/table.csv')).read())"})])
def test_a_file_that_is_edited_while_the_method_is_evaluated_is_refused(author, tmp_path, file, words):
    """Also those that no import statement names: the process says which files it opened."""
    (tmp_path / "w.txt").write_text("5.0")
    words = {key: value.format(here=str(tmp_path)) for key, value in words.items()}
    if "weights" in words:
        words["weights"] = str(tmp_path / "w.txt")

    edited = tmp_path / file
    with pytest.raises(MethodError, match=r"mine:Mine was changed while it was evaluated: .*has another content"):
        author(progress=lambda done, *_: done == 5 and edited.write_text(edited.read_text() + " "), **words)
    assert not (tmp_path / "r.json").exists() and not list(tmp_path.glob(KEPT))


def test_a_result_says_what_decided_it(author, tmp_path):
    (tmp_path / "w.txt").write_text("5.0")
    opens = f"""import contextlib
        for name in ({str(tmp_path / 'table.csv')!r}, '/sys/kernel/uevent_seqnum', '/' + 'x' * 300):
            with contextlib.suppress(OSError):
                open(name).read()"""  # no file has so long a name
    found = author(weights=str(tmp_path / "w.txt"), learns=opens)
    assert set(found.contents) == {"the method", "the harness", str(tmp_path / "w.txt"), "table.csv"}
    assert type(found).load(tmp_path / "r.json").contents == found.contents
    assert contents_of("mine:Mine", found.parameters, opened=found.contents) == found.contents


@pytest.mark.skipif(not works("namespaces"), reason="no namespaces here")
def test_every_file_of_a_folder_that_a_parameter_names_counts(task, toy_dataset, tmp_path, monkeypatch):
    """Also one that is first opened in a trial: in a container none of them can be written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tables" / "deep").mkdir(parents=True)
    table, folder = tmp_path / "tables" / "deep" / "a.txt", str(tmp_path / "tables")
    table.write_text("5.6")
    (tmp_path / "reads.py").write_text(
        "from toy_methods import Constant\n\nclass Reads(Constant):\n    def __init__(self, *, tables=''):\n"
        "        super().__init__()\n        self.tables = tables\n    def adapt(self, view, support):\n"
        "        self.value = float(open(self.tables + '/deep/a.txt').read())\n"
        "        try:\n            open(self.tables + '/note', 'w')\n        except OSError:\n"
        "            super().adapt(view, support)\n")

    def run(progress=lambda *_: None):
        return evaluate("reads:Reads", task, toy_dataset, check=False, seeds=1,
                        parameters={"tables": folder}, sandbox="namespaces", progress=progress)

    before = run().contents
    assert set(before) == {"the method", "the harness", folder}
    with pytest.raises(MethodError, match=rf"was changed while it was evaluated: {folder} has another content"):
        run(lambda done, *_: done == 3 and table.write_text("5.7"))
    assert contents_of("reads:Reads", {"tables": folder}, opened=before)[folder] != before[folder]


def test_answers_pass_through_the_particle_model_and_ceilings_through_the_solver(monkeypatch):
    sbml, ceiling = files_of("sbml"), files_of("resim")
    assert {"vsfsim.vsf.sticking", "vsfsim.vsf.observe", "vsfsim.core.rotation"} <= set(sbml)
    assert {"vsfsim.generate.resim", "vsfsim.physics.solve", "vsfsim.physics.contact"} <= set(ceiling)
    for found in (sbml, ceiling):
        assert not [name for name in found if name.startswith(("vsfsim.cli", "vsfsim.bench.leaderboard",
                                                               "vsfsim.bench.result", "vsfsim.data"))]
    found = {contents_of("sbml", {})["the harness"], method_sha256("sbml"), method_sha256("resim")}
    assert len(_SCORES) < 15 and len(found) == 3


@pytest.mark.parametrize("table", ["table.csv", os.fsdecode(b"caf\xe9.csv")])
def test_a_package_counts_with_every_file_in_it(tmp_path, table):
    (tmp_path / "lab").mkdir()
    for name, text in (("__init__.py", ""), ("mine.py", "class Mine: ...\n"), (table, "1\n")):
        (tmp_path / "lab" / name).write_text(text)
    before = method_sha256("lab.mine:Mine", tmp_path)
    (tmp_path / "lab" / table).write_text("2\n")
    assert method_sha256("lab.mine:Mine", tmp_path) != before


def test_a_file_whose_name_is_no_text_is_refused(author, tmp_path):
    """One that the method opens, and one that a parameter names."""
    name = os.fsdecode(b"caf\xe9")
    (tmp_path / name).write_text("5.6")
    with pytest.raises(MethodError, match=r"reads 'caf\\udce9'\. The name is not UTF-8, .* Rename the file"):
        author(learns=f"open({str(tmp_path)!r} + '/' + os.fsdecode(b'caf\\xe9')).read()")
    with pytest.raises(MethodError, match=r"a parameter cannot be written into a result file: .* surrogates not allow"):
        author(weights=str(tmp_path / name))
