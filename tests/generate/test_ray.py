"""Ray makes the dataset of one process: on two nodes of this machine, with workers and heads that are killed."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time

import pytest
from test_generate import SCENE

from vsfsim.core.engines import ray_cluster
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.generate.run import Share, generate

ray = pytest.importorskip("ray")

OBJECTS = 6


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "tiny.toml"
    path.write_text(SCENE.replace("count = 2", "count = 1"))
    return load_scene(path)


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    return generate(scene, tmp_path_factory.mktemp("one") / "d", workers=1, objects=OBJECTS)


@contextlib.contextmanager
def cluster(workers: int):
    """A test cluster of two nodes (one where there is one worker)."""
    from ray.cluster_utils import Cluster

    first = -(-workers // 2)
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": first, "object_store_memory": 100 << 20})
    try:
        if workers > first:
            made.add_node(num_cpus=workers - first, object_store_memory=100 << 20)
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def test_a_cluster_that_is_not_there_is_said_within_ten_seconds():
    began = time.perf_counter()
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1", "127.0.0.1:x"):
        with pytest.raises(VsfsimError, match=r"no Ray cluster at '.*127.0.0.1.*ray start --head"):
            list(ray_cluster.run(print, [1], address=address))
    assert time.perf_counter() - began < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 8])
def test_any_number_of_workers_gives_the_bytes_of_one_process(scene, made, tmp_path, workers):
    with cluster(workers) as there:
        found = generate(scene, tmp_path / "d", objects=OBJECTS, share=Share(ray=there.address))
    assert found.sha256 == made.sha256 and contents(tmp_path / "d") == contents(made.path)


RUN = """
import sys
from pathlib import Path
from vsfsim.core.scene import load_scene
from vsfsim.generate.run import Share, generate
generate(load_scene(Path(sys.argv[1])), Path(sys.argv[2]), objects=int(sys.argv[3]), share=Share(ray=sys.argv[4]))
"""


def driver(scene, out, address):
    return subprocess.Popen([sys.executable, "-c", RUN, str(scene.path), str(out), str(OBJECTS), address],
                            stderr=subprocess.DEVNULL)


def tasks_of(processes):
    """Process ids of the workers that make a view."""
    out = []
    for line in subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True).stdout.splitlines():
        number, _, words = line.strip().partition(" ")
        if words.startswith("ray::vsfsim"):
            out.append(int(number))
    return [number for number in out if number in processes or not processes]


@pytest.mark.slow
def test_twenty_kills_of_workers_and_one_of_the_head(scene, made, tmp_path):
    out, kills, rng = tmp_path / "d", 0, random.Random(0)
    with cluster(2) as there:
        process = driver(scene, out, there.address)
        deadline = time.perf_counter() + 240.0
        while process.poll() is None and kills < 20 and time.perf_counter() < deadline:
            time.sleep(rng.uniform(0.1, 0.8))
            found = tasks_of(())
            if found:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(rng.choice(found), signal.SIGKILL)
                    kills += 1
        there.head_node.kill_gcs_server(check_alive=False)
        if process.poll() is None:
            time.sleep(2.0)
            process.kill()
        process.wait()
    assert kills >= 5
    with cluster(2) as there:
        assert driver(scene, out, there.address).wait() == 0
    assert contents(out) == contents(made.path)
