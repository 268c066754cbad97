"""The hidden objects of `rope-punyo` and `bag-punyo`: layouts, covered on all sides, with a true mask and pose."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from vsfsim.bench.inclusions import Inclusions
from vsfsim.core.scene import Scene, SceneFile, load_scene
from vsfsim.core.shape import Box, Cylinder
from vsfsim.core.shelf import scenes
from vsfsim.data.streams import Stream, stream
from vsfsim.generate.effector import effector_of
from vsfsim.generate.recipe import make_recipe


def of(name: str, number: int) -> tuple[SceneFile, Scene]:
    written = load_scene(scenes()[name])
    return written, written.sample(stream(0, Stream.SCENE, number), number=number)


def grid(size: tuple[float, float, float], *, step: float = 0.002) -> np.ndarray:
    """Points (k, 3) [m] in a box that stands on z = 0."""
    axes = [np.arange(-0.5 * s + 0.5 * step, 0.5 * s, step) for s in size[:2]] + [np.arange(0.5 * step, size[2], step)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_twelve_ropes_lie_covered_in_the_bed() -> None:
    masks = []
    for number in range(12):
        _, scene = of("rope-punyo", number)
        assert isinstance(scene.object.shape, Box) and scene.required_touches.count == 66
        points = grid(scene.object.shape.size)
        inside = np.min([part.distance(points) for part in scene.object.young_modulus.inclusions], axis=0) <= 0.0
        low, high = points[inside].min(axis=0), points[inside].max(axis=0)
        # 2 mm of cover, and 20 mm to the edges of the bed, where a bubble would hang over
        assert 0.016 < high[2] < 0.0185 and low[2] > 0.005
        assert (np.abs([low[:2], high[:2]]) < np.array([0.082, 0.062])).all()
        masks.append(set(map(tuple, np.round(points[inside][:, :2], 4))))
    for one, other in itertools.combinations(range(12), 2):
        assert len(masks[one] & masks[other]) < 0.35 * len(masks[one] | masks[other])


def test_bags_hide_three_objects_in_four_poses_each() -> None:
    hidden, poses = [], []
    for number in range(12):
        _, scene = of("bag-punyo", number)
        body = scene.object
        assert isinstance(body.shape, Cylinder)
        points = grid((2 * body.shape.radius, 2 * body.shape.radius, body.shape.height))
        inside = np.min([part.distance(points) for part in body.young_modulus.inclusions], axis=0) <= 0.0
        assert np.hypot(*points[inside][:, :2].T).max() < body.shape.radius - 0.01
        assert body.shape.height - points[inside][:, 2].max() > 0.003
        hidden.append((body.young_modulus.inclusions[0].young_modulus, int(inside.sum())))
        poses.append((*body.pose, body.yaw))
    assert len(set(hidden)) == 3 and hidden[:3] * 4 == hidden
    assert len({value for value, _ in hidden}) == 3, "three stiffnesses"
    assert len(set(poses)) == 12


@pytest.mark.parametrize("name", ["rope-punyo", "bag-punyo"])
def test_the_truth_knows_the_hidden_object(name: str) -> None:
    written, scene = of(name, 4)
    truth = Inclusions.of(make_recipe(written), SimpleNamespace(object_index=4, name="four"))
    local = np.array(scene.object.young_modulus.inclusions[0].numbers[:3])
    c, s = np.cos(scene.object.yaw), np.sin(scene.object.yaw)
    world = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ local + scene.object.pose
    assert truth.inside(world[None]).all() and not truth.inside(world[None] + [0.0, 0.0, 0.02]).any()
    assert effector_of(scene).check(scene, None) == "fem-coarse"
