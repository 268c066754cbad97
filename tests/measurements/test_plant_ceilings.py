"""`vsfsim measure plant-ceilings`: displaced skeletons, moduli of classes, and what is left of the error."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from texts import changed

from measurements.plant_ceilings import (
    error,
    measure,
    predicted,
)
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.plants.subject import grow


def scene(folder, *, plant, yields):
    """The scene plants-v4-mini with a small plant and few frames."""
    path = folder / "small.toml"
    path.write_text(changed(find_scene("plants-v4-mini").read_text(), plant=f'"{plant}"', yields=yields,
                            wood_segments=60, leaf_segments=80, frames="{ free = 1, in = 12, out = 6 }",
                            reject_below=0.0))
    return str(path)


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    path = scene(tmp_path_factory.mktemp("plants"), plant="orange-tree", yields="true")
    return grow(load_scene(find_scene(path)).sample(0), 0)


def test_the_error_is_over_planned_frames_and_a_model_that_stops_holds_its_last():
    def touch(frames, torque):
        return SimpleNamespace(planned_frame=np.array(frames), converged=np.ones(len(frames), bool),
                               torque=np.repeat(np.array(torque, float)[:, None], 7, axis=1))

    true, short = touch([0, 1, 2, -1], [0.0, 3.0, 4.0, 99.0]), touch([0, 1], [0.0, 3.0])
    assert predicted(short, true)[:3, 0].tolist() == [0.0, 3.0, 3.0]
    assert error([short], [true]) == pytest.approx(0.2) and error([true], [true]) == 0.0
    nothing = touch([-1], [5.0])
    assert error([nothing], [true]) == pytest.approx(1.0)


@pytest.mark.slow
def test_the_true_plant_leaves_nothing(tmp_path):
    found = measure(scene=scene(tmp_path, plant="orange-tree", yields="true"), objects=1, touches=17, shots=(2,))
    rows = found.tables[0].rows
    assert rows[0]["jitter"] == 0.0 and rows[0]["true"] < 1e-6
    assert rows[0]["true"] < rows[1]["true"] < rows[2]["true"]
