"""Reads mutated files with every reader of files from strangers, in a process that may hold one gibibyte.

`test_fuzz.py` runs it: `python fuzz_readers.py FOLDER EXAMPLES`. A reader may refuse a file with a
`VsfsimError`; any other exception, a crash, or a larger allocation is a failure of the test.
"""

import json
import resource
import sys
from functools import partial
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vsfsim.bench.commands.score import read_predictions as arrays_of
from vsfsim.bench.result import Result
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import parse_scene
from vsfsim.data.dataset import Dataset
from vsfsim.data.hdf5 import read_view
from vsfsim.data.manifest import manifest_bytes

FOLDER, EXAMPLES = Path(sys.argv[1]), int(sys.argv[2])
LIMIT = 1 << 30

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
    | st.sampled_from([10**400, 1e308, "../../x", "\x1b[2J", -1, 0, "nan"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3), max_leaves=6)


def replaced(data, tree):
    """A JSON tree with one of its parts replaced, removed or doubled."""
    path, node = [], tree
    while isinstance(node, (dict, list)) and node and (not path or data.draw(st.integers(0, 3))):
        key = data.draw(st.sampled_from(sorted(node) if isinstance(node, dict) else range(min(len(node), 5))))
        path.append((node, key))
        node = node[key]
    parent, key = path[-1]
    action = data.draw(st.sampled_from(["replace", "remove", "double"]))
    if action == "remove":
        del parent[key]
    elif action == "double" and isinstance(parent, list):
        parent.append(parent[key])
    else:
        parent[key] = data.draw(values)
    return tree


def mutated(data, content):
    """Bytes with a few of them changed, cut out or moved."""
    out = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, max(len(out) - 1, 0)))
        what = data.draw(st.sampled_from(["byte", "large", "cut", "repeat"]))
        if what == "byte":
            out[at:at + 1] = bytes([data.draw(st.integers(0, 255))])
        elif what == "large":
            out[at:at + 8] = b"\xff\xff\xff\xff\xff\xff\xff\x7f"
        elif what == "cut":
            del out[at:at + data.draw(st.integers(1, 200))]
        else:
            out[at:at] = out[at:at + data.draw(st.integers(1, 200))]
    return bytes(out)


def read_object_file(data):
    path = FOLDER / "mutated.h5"
    path.write_bytes(mutated(data, (FOLDER / "toy" / "mock-0001-v0.h5").read_bytes()))
    read_view(path)


def read_manifest(data):
    table = replaced(data, json.loads((FOLDER / "toy" / "dataset.json").read_text()))
    folder = FOLDER / "mutated"
    folder.mkdir(exist_ok=True)
    content = manifest_bytes(table)
    (folder / "dataset.json").write_bytes(content)
    dataset = Dataset.open(folder)
    for name in dataset.names():
        dataset.load(name)


def read_result(data, name="result.json"):
    path = FOLDER / "mutated.json"
    content = (FOLDER / name).read_text()
    if data.draw(st.booleans()):
        path.write_text(json.dumps(replaced(data, json.loads(content))))
    else:
        path.write_bytes(mutated(data, content.encode()))
    result = Result.load(path)
    assert result.values or result.computed()


def read_predictions(data):
    path = FOLDER / "mutated.npz"
    path.write_bytes(mutated(data, (FOLDER / "predictions.npz").read_bytes()))
    arrays_of(path, {"a/0/0/000": (12, 1), "b/5/1/011": (12, 1)})


def read_task(data):
    parse_task(mutated(data, (FOLDER / "task.toml").read_bytes()).decode(errors="replace"), "task.toml")


def read_scene(data):
    parse_scene(mutated(data, (FOLDER / "scene.toml").read_bytes()).decode(errors="replace"), "scene.toml").sample(0)


READERS = {"object": read_object_file, "manifest": read_manifest, "result": read_result,
           "row": partial(read_result, name="row.json"), "predictions": read_predictions, "task": read_task,
           "scene": read_scene}


def fuzz(name, read):
    @settings(max_examples=EXAMPLES, deadline=None, derandomize=True, database=None,
              suppress_health_check=list(HealthCheck))
    @given(st.data())
    def try_one(data):
        try:
            read(data)
        except VsfsimError as error:
            assert "\n" not in str(error).strip() or name in ("task", "scene"), "one paragraph"

    try_one()


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT, LIMIT))
    for one in READERS.items():
        fuzz(*one)
    print(f"{EXAMPLES} files for each of {len(READERS)} readers")
