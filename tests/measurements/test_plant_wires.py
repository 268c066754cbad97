"""`vsfsim measure plant-yield`: touches of a plant whose wires yield beside those of an elastic one."""

from __future__ import annotations

import numpy as np
import pytest

from measurements.artificial_plants.wires import measure
from vsfsim.core.errors import VsfsimError
from vsfsim.core.shelf import find_scene


def scene(folder, *, plant, yields):
    """The scene plants-v4-mini with a small plant and few frames."""
    text = find_scene("plants-v4-mini").read_text()
    for old, new in (('plant = "by-object"', f'plant = "{plant}"'), ("yields = true", f"yields = {yields}"),
                     ("wood_segments = 120", "wood_segments = 60"), ("leaf_segments = 300", "leaf_segments = 80"),
                     ("frames = { free = 5, in = 46, hold = 2, out = 0 }", "frames = { free = 1, in = 12, out = 6 }"),
                     ("reject_below = 1.2", "reject_below = 0.0")):
        assert old in text, old
        text = text.replace(old, new)
    path = folder / "small.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.slow
def test_an_orange_tree_gives_way_and_stays_bent(tmp_path):
    found = measure(scene=scene(tmp_path, plant="orange-tree", yields="true"), objects=1, touches=4)
    (row,) = found.tables[0].rows
    assert row["share"] > 0.4 and row["force"] <= row["elastic_force"] * 1.05
    assert found.numbers["share_yielding"] == row["share"] and (np.isnan(row["bent"]) or row["bent"] > 0.0)


def test_a_scene_without_yielding_wires_is_refused(tmp_path):
    with pytest.raises(VsfsimError, match="no wire of plants-v4-mini yields"):
        measure(scene=scene(tmp_path, plant="boxwood", yields="false"), objects=1, touches=1)
