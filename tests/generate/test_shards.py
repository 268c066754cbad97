"""Many machines make one dataset: shards, a store of objects, views that fail, machines of two kinds."""

import json
import os
import re
import shutil
import signal

import pytest
from mock_dataset import contents, recipe_of

from vsfsim.bench.mock import mock_view
from vsfsim.core.errors import DatasetError, VsfsimError
from vsfsim.core.system import engines
from vsfsim.core.system.engines import Fan, shard_of
from vsfsim.data import lines
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import Store
from vsfsim.data.verify import verify
from vsfsim.data.writer import DatasetWriter
from vsfsim.generate import workers
from vsfsim.generate.effector import effector_of
from vsfsim.generate.run import generate, make, planned


@pytest.fixture(scope="module")
def scene(loaded):
    return loaded("sprung", count=1)


@pytest.fixture(scope="module")
def made(generated):
    return generated("sprung", count=1)


def test_shards_in_any_order_give_the_bytes_of_one_process(scene, made, tmp_path, here):
    out = tmp_path / "d"
    for k in (2, 0, 1):
        found = make(planned(scene, out, fan=Fan((k, 3))))
        assert len(found.names) == 1 and found.dataset is None
    with pytest.raises(DatasetError, match="unfinished"):
        Dataset.open(out)
    assert found.unfinished == 0
    line = json.loads((out / "manifest" / "sprung-0000-v0.json").read_text())
    assert line["bytes"] == (out / line["file"]).stat().st_size and line["seed"] == 0 and line["made_on"]
    assert make(planned(scene, out)).dataset.sha256 == made.sha256
    assert contents(out) == contents(made.path) and verify(out).ok
    assert "3 object views" in (out / "README.md").read_text()


def test_an_owner_does_not_begin_beside_a_shard_nor_the_same_shard_twice(scene, tmp_path):
    given = tmp_path / "d", recipe_of([mock_view(0), mock_view(1)]), ["a", "b"]
    with DatasetWriter(*given, shard=(0, 2)):
        DatasetWriter(*given, shard=(1, 2)).close()
        for shard in (None, (0, 2)):
            with pytest.raises(DatasetError, match=f"being written by process {os.getpid()}"):
                DatasetWriter(*given, shard=shard)


def test_machines_of_two_kinds_are_not_mixed_unless_asked(scene, made, tmp_path, here, monkeypatch):
    make(planned(scene, tmp_path, fan=Fan((0, 2))))
    monkeypatch.setattr(workers, "machine_kind", lambda *_: "another CPU")
    with pytest.raises(DatasetError, match=r"begun on '.*', and this machine is 'another CPU'.*--allow mixed"):
        make(planned(scene, tmp_path, fan=Fan((1, 2))))
    make(planned(scene, tmp_path, allow=["mixed"], fan=Fan((1, 2))))
    found = make(planned(scene, tmp_path)).dataset
    assert {e.made_on for e in found.entries} == {made.entries[0].made_on, "another CPU"}
    assert found.sha256 == made.sha256 and verify(tmp_path).ok
    shutil.copytree(made.path, tmp_path / "finished")
    (tmp_path / "finished" / made.entries[1].file).unlink()
    with pytest.raises(DatasetError, match="this machine is 'another CPU'"):
        generate(scene, tmp_path / "finished")


def test_a_view_that_fails_twice_is_left_out_and_the_others_are_made(scene, made, tmp_path, here, monkeypatch):
    probe = effector_of(scene.sample(0))
    calls, real = [], type(probe).make_view

    def make_view(self, job, **options):
        calls.append(job.name)
        if job.name == "sprung-0001-v0":
            raise RuntimeError("no luck")
        return real(self, job, **options)

    monkeypatch.setattr(type(probe), "make_view", make_view)
    found = make(planned(scene, tmp_path / "d", allow=["poison"]))
    assert calls.count("sprung-0001-v0") == 2 and len(found.dataset) == 2 and verify(tmp_path / "d").ok
    assert found.left_out == {"sprung-0001-v0": "RuntimeError: no luck"}
    assert "no luck" in (tmp_path / "d" / "README.md").read_text()
    again = make(planned(scene, tmp_path / "d", allow=["poison"]))
    assert again.left_out == found.left_out and len(calls) == 4, "what is finished is left"


def test_an_object_store_holds_the_same_dataset(scene, made, here, tmp_path, monkeypatch):
    pytest.importorskip("fsspec")
    monkeypatch.setenv("VSFSIM_FETCHED", str(tmp_path))
    url = f"memory://{tmp_path.name}/d"
    for k in range(2):
        make(planned(scene, url, fan=Fan((k, 2))))
    with pytest.raises(DatasetError, match="unfinished"):
        Dataset.open(url)
    found = make(planned(scene, url)).dataset
    assert found.sha256 == made.sha256 and found.origin == url
    assert found[1].touches[0].force.tobytes() == made[1].touches[0].force.tobytes()
    assert sorted(Store(url).sizes()) == sorted(contents(made.path))
    assert Store(url).get("dataset.json") == (made.path / "dataset.json").read_bytes()


@pytest.mark.parametrize(("given", "env", "found"), [("1/4", {}, (1, 4)), ("auto", {
    "SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_MIN": "5",
    "SLURM_ARRAY_TASK_COUNT": "4"}, (2, 4)), ("auto/3", {"JOB_COMPLETION_INDEX": "2"}, (2, 3)),])
def test_shards_are_read(given, env, found):
    assert shard_of(given, env) == found


@pytest.mark.parametrize(("given", "env"), [
    ("4/4", {}), ("-1/4", {}), ("1", {}), ("a/b", {}), ("", {}), ("0/0", {}), ("auto", {}),
    ("auto/4", {"SLURM_ARRAY_TASK_ID": "x"}),
])
def test_shards_that_are_none_are_refused(given, env):
    with pytest.raises(VsfsimError, match=r"--shard|SLURM"):
        shard_of(given, env)


def test_the_files_for_schedulers_hold_the_command():
    words = ["generate", "x", "--out", "a b"]
    batch = engines.job_file("slurm", words, 4)
    assert "--array=0-3" in batch and "srun vsfsim cluster --shard auto generate x --out 'a b' --workers" in batch
    yaml = pytest.importorskip("yaml")
    job = yaml.safe_load(engines.job_file("k8s", words, 3, gpus=1))
    assert job["spec"]["completions"] == 3 and job["spec"]["completionMode"] == "Indexed"
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert container["command"][:8] == ["vsfsim", "cluster", "--shard", "auto/3", *words]
    assert container["resources"]["limits"]["nvidia.com/gpu"] == "1"
    assert container["workingDir"] == "/work" and job["spec"]["template"]["spec"]["volumes"]
    other = yaml.safe_load(engines.job_file("k8s", [*words[:-1], "s3://b/Data_1.x"], 3))
    assert "volumes" not in other["spec"]["template"]["spec"], "an object store needs none"
    names = [one["metadata"]["name"] for one in (job, other)]
    assert len(set(names)) == 2 and all(re.fullmatch(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?", name) for name in names)


@pytest.mark.parametrize(("engine", "word", "message"), [
    ("k8s", "/home/me/shoes", "'/home/me/shoes' is a path of this machine"),
    ("k8s", "--out=/home/me/shoes", "is a path of this machine"), ("k8s", "~/shoes", "is a path of this machine"),
    ("k8s", "a\nkind: Pod", "a character that ends a line"), ("slurm", "a\u2028b", "a character that ends a line")])
def test_words_that_a_job_cannot_have_are_refused(engine, word, message):
    with pytest.raises(VsfsimError, match=message):
        engines.job_file(engine, ["generate", word], 3)


@pytest.mark.parametrize(("kept", "told"), [(0, "nothing was finished"), (1, "Run the same command again")])
def test_sigterm_between_a_file_and_its_line(scene, made, tmp_path, here, monkeypatch, vsfsim, kept, told):
    """The signal arrives at the worst moment: the file lies there and its line does not. Whatever is in it, it is made
    again; a view that was finished before is kept."""
    words = ("generate", scene.path, "--out", "d")
    before, real = signal.getsignal(signal.SIGTERM), lines.put_line
    files = [f"sprung-{k:04d}-v0.h5" for k in range(kept + 1)]

    def put_line(store, entry, recipe):
        if entry.file == files[-1]:
            signal.raise_signal(signal.SIGTERM)
        real(store, entry, recipe)

    try:
        with monkeypatch.context() as patch:
            patch.setattr(lines, "put_line", put_line)
            stopped = vsfsim(*words, cwd=tmp_path)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert stopped.returncode == 143 and told in stopped.stderr
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["dataset.part.json", "manifest", *files]
    (tmp_path / "d" / files[-1]).write_bytes((made.path / "sprung-0002-v0.h5").read_bytes())
    assert vsfsim(*words, cwd=tmp_path).stdout.startswith("d: 3 object views, ")
    assert contents(tmp_path / "d") == contents(made.path)


def test_a_device_without_memory_is_told():
    with pytest.raises(DatasetError, match=r"plants: the memory of cuda:0 does not suffice.*--touches"):
        with workers.enough_memory("plants", "cuda:0"):
            raise RuntimeError("CUDA error 2: out of memory")
