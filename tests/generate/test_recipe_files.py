"""Every file that a scene names belongs to the recipe of its dataset by its content."""

import dataclasses

import pytest
import trimesh
from texts import text

from vsfsim.core.errors import DatasetError
from vsfsim.core.scene import load_scene
from vsfsim.data.dataset import Dataset
from vsfsim.data.verify import verify
from vsfsim.generate import workers
from vsfsim.generate.recipe import files_of, make_recipe
from vsfsim.generate.run import generate


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "named.toml").write_text(text("named"))
    trimesh.creation.box((0.06, 0.06, 0.06)).export(tmp_path / "thing.stl")
    return load_scene(tmp_path / "named.toml")


def taller(scene):
    trimesh.creation.box((0.06, 0.06, 0.07)).export(scene.path.parent / "thing.stl")


def test_a_mesh_that_was_replaced_between_kill_and_resume_is_told(scene, tmp_path, here, monkeypatch):
    with monkeypatch.context() as patch:
        written, original = [], workers.write

        def write(job, view, device):
            if written:
                raise KeyboardInterrupt
            written.append(job.name)
            return original(job, view, device)

        patch.setattr(workers, "write", write)
        with pytest.raises(KeyboardInterrupt):
            generate(scene, tmp_path / "data", workers=1)
    assert (tmp_path / "data" / "dataset.part.json").exists()
    before = (tmp_path / "thing.stl").read_bytes()
    taller(scene)
    with pytest.raises(DatasetError, match=r"holds another dataset: thing\.stl has another content \(sha256 "):
        generate(scene, tmp_path / "data", workers=1)
    (tmp_path / "thing.stl").write_bytes(before)
    made = generate(scene, tmp_path / "data", workers=1)
    assert set(made.recipe.files) == {"thing.stl"} and verify(made.path).ok
    assert Dataset.open(made.path).recipe == made.recipe


def test_a_mesh_that_is_replaced_while_the_dataset_is_made_is_told(scene, tmp_path, here, monkeypatch):
    original = workers.write

    def write(job, view, device):
        entry = original(job, view, device)
        taller(scene)
        return entry

    monkeypatch.setattr(workers, "write", write)
    with pytest.raises(DatasetError, match=r"cannot go on, because while it was made thing\.stl has another content"):
        generate(scene, tmp_path / "data", workers=1)
    assert not (tmp_path / "data" / "dataset.json").exists()


def test_a_mesh_of_an_obstacle_counts_too_and_a_scene_without_files_has_none(scene, tmp_path):
    (tmp_path / "plain.toml").write_text(text("named", ('mesh = "thing.stl"', "box = [0.06, 0.06, 0.03]")))
    plain = make_recipe(load_scene(tmp_path / "plain.toml"))
    assert plain.files == {} and "files" not in plain.table()
    tree = dataclasses.replace(scene, tree={"obstacles": [{"shape": {"mesh": str(tmp_path / "thing.stl")}}]})
    assert set(files_of(tree, "probe")) == {str(tmp_path / "thing.stl")}
