"""Proof by addition: a new sensor is a package with an effector, a row of the schema and an observation.

The package below, a load cell behind a rigid probe, is found through its entry points.
`generate`, `verify`, `load`, `press`, `evaluate` and a baseline take it as it is.
"""

import importlib
import importlib.metadata
import json
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
from texts import text

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.metrics import METRICS
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import DatasetError, VsfsimError
from vsfsim.core.shelf import Registry
from vsfsim.data import schema
from vsfsim.data.hdf5 import examine, read_view
from vsfsim.data.verify import verify
from vsfsim.press.command import press

READING = '''
"""What a load cell reads, and what a task asks of it; scoring needs no more."""

import numpy as np

from vsfsim.bench.metrics import Answer, Metric
from vsfsim.bench.noise import noisy_force
from vsfsim.bench.observations import Channel, Observation
from vsfsim.data import schema

schema.FIELDS.append(schema.Field("touches/*/channels/cell_force", "float64", ("T",), "N",
                                  "Force along the axis of the load cell.", required=False, masked=True))


def noise(values, time, force, noise, **touch):
    return noisy_force(np.tile(values[:, None], 3), time, np.tile(values[:, None], 3), noise, **touch)[:, 0]


OBSERVATION = Observation(
    "cell-force", "N", 1,
    Channel("load cell", "a load cell, a [sensor]", lambda touch: touch.channel("cell_force"), noise),
    lambda force, axis: force[:, None], "vsfsim.vsf.observations:normal_force", "Force along the load cell's axis.",
    along_press=True)
WORST = Metric("worst_touch", Answer.READINGS,
               lambda touches: max((touch["sse"] / touch["n"]) ** 0.5 for touch in touches),
               "Largest root mean square error of a touch.", unit=None, ranks=True)
'''

LOAD_CELL = '''
"""A flat load cell behind a rigid probe: it reads the force along its axis in steps, up to its range."""

import dataclasses
from typing import Annotated

import numpy as np

import cell_reading  # noqa: F401  (its row of the schema)
from vsfsim.core.errors import SceneError
from vsfsim.core.table import between, typed
from vsfsim.generate.effectors.probe import Probe
from vsfsim.generate.press_result import Column


@dataclasses.dataclass(frozen=True)
class Cell:
    range: Annotated[float, between(0.1, 1e4, "N")] = 50.0
    step: Annotated[float, between(1e-6, 10.0, "N")] = 0.01


class LoadCell(Probe):
    table = "sensor"

    def settings(self, scene):
        table = typed(scene.effector_table, Cell, f"{scene.source} [sensor]", also=("kind",))
        return table.range, table.step

    def check(self, scene, tier):
        self.settings(scene)
        return super().check(scene, tier)

    def channels(self, scene):
        return (*super().channels(scene), "cell_force")

    def make_view(self, job, *, device):
        view, (most, step) = super().make_view(job, device=device), self.settings(job.scene())
        return dataclasses.replace(view, touches=tuple(
            dataclasses.replace(touch, channels={"cell_force": self.reading(touch.normal_force(), most, step)})
            for touch in view.touches))

    def press(self, loaded, request):
        result, (most, step) = super().press(loaded, request), self.settings(loaded.sample(request.seed))
        cell = self.reading(result.force[:, 2], most, step)
        return dataclasses.replace(
            result, more={**result.more, "cell_force": cell},
            readings=(*result.readings, Column("cell N", cell, ".2f")),
            plot={**result.plot, "load cell [N]": {"reading": cell}},
            arrays={**result.arrays, "cell_force": (cell, "reading of the load cell (T,) [N]")})

    @staticmethod
    def reading(force, most, step):
        return step * np.rint(np.clip(force, -most, most) / step)


EFFECTOR = LoadCell()
'''

ENTRIES = """
[vsfsim.effectors]
load-cell = load_cell:EFFECTOR
[vsfsim.observations]
cell-force = cell_reading:OBSERVATION
[vsfsim.metrics]
worst_touch = cell_reading:WORST
"""

@pytest.fixture(scope="module")
def load_cell(tmp_path_factory):
    """The package, as an installer leaves it in a folder of the path, and its effector's module."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "load_cell-1.0.dist-info").mkdir()
    for name, content in (("load_cell.py", LOAD_CELL), ("cell_reading.py", READING),
                       ("load_cell-1.0.dist-info/METADATA", "Name: load-cell\nVersion: 1.0\n"),
                       ("load_cell-1.0.dist-info/entry_points.txt", ENTRIES)):
        (folder / name).write_text(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)  # processes that are spawned have the same path
        patch.setattr(schema, "FIELDS", [*schema.FIELDS])
        yield importlib.import_module("load_cell")
        for table, name in ((OBSERVATIONS, "cell-force"), (METRICS, "worst_touch")):
            table.pop(name)
    for name in ("load_cell", "cell_reading"):
        sys.modules.pop(name)


@pytest.fixture(scope="module")
def made(load_cell, generated):
    return generated("weighed")


def test_a_dataset_has_what_the_sensor_reads(made):
    report = verify(made.path)
    assert report.ok and report.touches == 12, report.text()
    clipped = 0
    for view in made:
        for touch in view.touches:
            cell = touch.channels["cell_force"]
            assert cell == pytest.approx(np.clip(touch.normal_force(), -2.0, 2.0), abs=0.025 + 1e-12)
            assert cell / 0.05 == pytest.approx(np.rint(cell / 0.05))
            clipped += int((cell == 2.0).sum())
    assert clipped > 0, "the range was meant to be met"
    with h5py.File(made.path / made.entries[0].file, "r") as file:
        said = dict(file["touches/000/channels/cell_force"].attrs)
    assert said == {"units": "N", "dims": "T", "doc": "Force along the axis of the load cell.", "masked": True}


def test_a_method_is_scored_on_it(made):
    task = parse_task(text("weighed-v1"), "weighed-v1.toml")
    result = evaluate("point-vsf", task, made, seeds=1, check=False)
    assert result.scores["rmse_ratio"]["3"].mean < 0.9, "of predicting nothing"
    worst = max(sse / n for shot, run, n, sse in zip(*(result.queries[k] for k in (
        "shot", "seed", "n", "sse"))) if (shot, run) == ("3", 0))
    assert result.scores["worst_touch"]["3"].per_seed[0] == pytest.approx(worst**0.5)


def test_the_dataset_is_read_and_verified_without_the_package(made):
    """In a Python that does not have it; the task that asks for its reading needs it and says so."""
    code = (f"import vsfsim; from vsfsim.data.verify import verify; report = verify({str(made.path)!r});"
            f"assert report.ok, report.text(); view = vsfsim.load({str(made.path)!r})[0];"
            f"print(view.touches[0].channels['cell_force'].tolist());"
            f"from vsfsim.bench.task import parse_task; parse_task({text('weighed-v1')!r}, 'weighed-v1.toml')")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert json.loads(out.stdout) == made[0].touches[0].channels["cell_force"].tolist(), out.stderr
    assert "observation 'cell-force' is unknown" in out.stderr and "once that is installed" in out.stderr


@pytest.mark.parametrize(("key", "value", "message"), [
    ("doc", None, "its attributes do not describe it"), ("masked", 7, "its attributes do not describe it"),
    ("dims", "T 3", "has shape"), ("units", "kg", None)])
def test_a_channel_that_is_described_badly_is_refused(made, tmp_path, monkeypatch, key, value, message):
    monkeypatch.setattr(schema, "FIELDS", [field for field in schema.FIELDS if "cell_force" not in field.path])
    file = tmp_path / made.entries[0].file
    shutil.copy(made.path / made.entries[0].file, file)
    with h5py.File(file, "r+") as opened:
        attributes = opened["touches/000/channels/cell_force"].attrs
        del attributes[key]
        if value is not None:
            attributes[key] = value
    found = examine(file)[1]
    if message is None:  # another unit is the file's own affair while nobody else knows the channel
        assert not found and read_view(file).touches[0].channels["cell_force"].shape == (4,)
        return
    assert len(found) == 1 and message in found[0], found
    with pytest.raises(DatasetError, match=message):
        read_view(file)


def test_a_row_that_cannot_be_loaded_is_named(monkeypatch):
    table = Registry("vsfsim.tests", {})
    entries = {name: importlib.metadata.EntryPoint(name, value, "vsfsim.tests") for name, value in (
        ("gone", "no_such_module:ROW"), ("other", "vsfsim.bench.observations:PRESSURE"))}
    monkeypatch.setattr("vsfsim.core.shelf._entries", lambda group, path: entries)
    assert list(table) == ["gone", "other"] and "gone" in table and "third" not in table and table.get("third") is None
    with pytest.raises(VsfsimError, match=r"'gone' \(no_such_module:ROW, entry point of vsfsim.tests\) cannot be"):
        table["gone"]
    with pytest.raises(VsfsimError, match="is the row 'pressure'; the name of the entry point must be"):
        table["other"]


def test_it_is_pressed_printed_drawn_and_saved(load_cell, tmp_path):
    (tmp_path / "weighed.toml").write_text(text("weighed"))
    made = press(tmp_path / "weighed.toml")
    made.plot(tmp_path / "p.png")
    made.picture(tmp_path / "q.png")
    made.save(tmp_path / "s.npz")
    numbers = made.table()
    assert made.converged and "cell N" in made.text().splitlines()[0]
    force = np.array(numbers["force"])[:, 2]
    assert force[-1] > 0.1 and numbers["cell_force"] == pytest.approx(np.clip(force, -2.0, 2.0), abs=0.025 + 1e-12)
    assert np.load(tmp_path / "s.npz")["cell_force"].tolist() == numbers["cell_force"]
    assert all((tmp_path / name).read_bytes()[:4] == b"\x89PNG" for name in ("p.png", "q.png"))


def test_a_channel_that_is_declared_and_not_recorded_is_refused(load_cell, made, tmp_path):
    from vsfsim.generate.job import jobs_of
    from vsfsim.generate.workers import write

    job = jobs_of(made.recipe, tmp_path / "weighed.toml", tmp_path)[0]
    view = load_cell.Probe().make_view(job, device="cpu")
    with pytest.raises(DatasetError, match="declares the channel 'cell_force' and did not record it"):
        write(job, view, "cpu")
    assert not list(tmp_path.rglob(f"{job.name}*"))
