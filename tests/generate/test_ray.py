"""Ray makes the dataset of one process, on two nodes of this machine."""

import contextlib
import time

import pytest
from mock_dataset import contents

from vsfsim.core.errors import VsfsimError
from vsfsim.core.system import engines
from vsfsim.core.system.engines import Fan
from vsfsim.generate.run import generate

ray = pytest.importorskip("ray")

OBJECTS = 6


@pytest.fixture(scope="module")
def scene(loaded):
    return loaded("tiny", count=1)


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    return generate(scene, tmp_path_factory.mktemp("one") / "d", workers=1, objects=OBJECTS)


@contextlib.contextmanager
def cluster(workers: int):
    """A test cluster of two nodes."""
    from ray.cluster_utils import Cluster

    first = -(-workers // 2)
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": first, "object_store_memory": 100 << 20})
    try:
        made.add_node(num_cpus=workers - first, object_store_memory=100 << 20)
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def test_a_cluster_that_is_not_there_is_said_within_ten_seconds():
    began = time.perf_counter()
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1", "127.0.0.1:x"):
        with pytest.raises(VsfsimError, match=r"no Ray cluster at '.*127.0.0.1.*ray start --head"):
            list(engines.on_ray(print, [1], address=address))
    assert time.perf_counter() - began < 10.0


@pytest.mark.slow
def test_workers_of_two_nodes_give_the_bytes_of_one_process(scene, made, tmp_path):
    with cluster(3) as there:
        found = generate(scene, tmp_path / "d", objects=OBJECTS, fan=Fan(ray=there.address))
    assert found.sha256 == made.sha256 and contents(tmp_path / "d") == contents(made.path)
