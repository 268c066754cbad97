"""From a scene to a dataset: whole, the same bits for any number of workers and after any number of kills."""

import os
import signal

import numpy as np
import pytest
from mock_dataset import contents

from vsfsim.core.errors import DatasetError, SceneError
from vsfsim.data.streams import Stream, stream
from vsfsim.data.verify import verify
from vsfsim.generate.recipe import make_recipe, splits_for
from vsfsim.generate.run import generate


@pytest.fixture(scope="module")
def scene(loaded):
    return loaded("tiny")


@pytest.fixture(scope="module")
def made(generated):
    """The dataset made without a break, in this process."""
    return generated("tiny")


def test_it_is_whole_and_verifies(made, scene):
    report = verify(made.path)
    assert report.ok, report.text()
    assert report.files == 2 and report.touches == 4 and report.frames == 16 and report.worst_balance <= 1e-3
    assert made.recipe.scene_text == scene.text and made.recipe.tier == "fem-coarse" and made.recipe.seed == 0
    assert made.names("train") == ("tiny-0000-v0",) and made.names("test") == ("tiny-0001-v0",)
    views = list(made)
    assert [v.split for v in views] == ["train", "test"]
    for v in views:
        assert v.view.rgb.shape == (48, 64, 3) and v.view.mask.any() and v.view.points().shape[1] == 3
        for touch in v.touches:
            assert touch.converged.all() and touch.touched and not touch.reason.any()
            # free, in, in, out: no force before contact, most at the deepest, and out over the pose of the way in
            force = touch.normal_force()
            assert force[0] == 0.0 and force[2] == force.max() > 0.0
            assert force[2] > force[1] > 0.0
            assert np.abs(touch.force - touch.reaction).max() <= 1e-3 * np.abs(touch.force).max()
            assert touch.target[2] >= 0.0 and touch.axis == pytest.approx(-touch.normal)


def test_the_truth_is_the_scenes(made, scene):
    bases = []
    for v in made:
        concrete = scene.sample(stream(0, Stream.SCENE, v.object_index))
        bases.append(concrete.object.young_modulus.base)
        truth = v.truth
        # back into the object's frame, where the scene's field lives
        c, s = np.cos(0.4), np.sin(0.4)
        local = (truth.points - [0.01, -0.02, 0.0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        # the inclusion's face is a plane of the mesh: no element has two materials
        assert truth.young_modulus == pytest.approx(concrete.object.young_modulus.evaluate(local), rel=1e-12)
        assert len(np.unique(truth.young_modulus.round(3))) == 2
        assert (truth.probe_stiffness > 0.0).all() and len(truth.probe_points) == len(truth.probe_stiffness) > 0
        assert np.linalg.norm(truth.probe_normals, axis=1) == pytest.approx(1.0)
        assert (truth.vsf_stiffness >= 0.0).all() and truth.vsf_touched.any() and not truth.vsf_touched.all()
        # stiffer where the material is stiffer: the softest of the stiff half beats the mean of the soft one
        at = (truth.probe_points - [0.01, -0.02, 0.0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        top = at[:, 2] > 0.0299
        stiff, soft = truth.probe_stiffness[top & (at[:, 0] > 0.01)], truth.probe_stiffness[top & (at[:, 0] < -0.01)]
        assert len(stiff) and len(soft) and stiff.mean() > soft.mean()
    assert bases[0] != bases[1] and all(2e4 <= b <= 2e5 for b in bases)


def test_two_workers_give_the_same_bits(made, scene, tmp_path):
    generate(scene, tmp_path / "two", workers=2)
    assert contents(tmp_path / "two") == contents(made.path)


@pytest.mark.slow
def test_another_seed_gives_another_dataset_and_more_objects_and_views_keep_the_first(made, scene, tmp_path, here):
    other = generate(scene, tmp_path / "seed", seed=1, objects=1)
    assert other.entries[0].sha256 != made.entries[0].sha256
    assert other.load("tiny-0000-v0").truth.young_modulus.min() != made.load("tiny-0000-v0").truth.young_modulus.min()
    again = generate(scene, tmp_path / "first", objects=1, views=3)
    # the camera goes round the object counter-clockwise, a third of a turn a view
    turned = np.unwrap([np.arctan2(*v.view.camera_pose[1::-1, 2]) for v in again])
    assert np.diff(turned) == pytest.approx(2.0 * np.pi / 3.0)
    a, b = again.load("tiny-0000-v0"), made.load("tiny-0000-v0")
    assert all(np.array_equal(p.force, q.force) for p, q in zip(a.touches, b.touches))


def leave(job, device):
    """Stands in for the function that makes a view: the system kills the worker, as it does when memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_is_killed_is_said_to_be(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("vsfsim.generate.workers.make_one", leave)
    with pytest.raises(DatasetError, match=r"a worker process ended before .* out of memory. Run the same"):
        generate(scene, tmp_path / "d", workers=2)
    assert not list((tmp_path / "d").glob("*.h5"))


def test_splits_keep_their_proportions(scene):
    concrete = scene.sample(0)
    assert splits_for(concrete, 2) == {"train": 1, "test": 1}
    assert splits_for(concrete, 10) == {"train": 5, "test": 5}
    assert sum(splits_for(concrete, 7).values()) == 7


@pytest.mark.parametrize("given", [{"objects": 0}, {"views": 0}, {"touches": 0}, {"seed": -1}])
def test_a_dataset_of_nothing_is_refused(scene, given):
    with pytest.raises(SceneError, match="it must be at least 1"):
        make_recipe(scene, **given)


def test_a_worker_that_fails_says_why_though_others_are_called_off(loaded, tmp_path):
    # from the side only the walls are seen, and a ball ten times as high as they are meets the table first
    blocked = loaded("tiny", ("sphere = 0.01", "sphere = 0.3"), ("[camera]", "[camera]\nelevation = 0.0"))
    with pytest.raises(SceneError, match="no target of 200 can be reached"):
        generate(blocked, tmp_path / "data", objects=5, workers=1)
    assert not (tmp_path / "data").exists(), "nothing was made, and nothing is left"
