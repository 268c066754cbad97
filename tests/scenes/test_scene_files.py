"""The shipped scenes load, sample and can be built; those with a press start just out of contact."""

from __future__ import annotations

import numpy as np
import pytest

from vsfsim.core import shelf
from vsfsim.core.scene import load_scene
from vsfsim.core.shape import Box, Plane, Sphere
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.physics.mesh.discretise import build_solid
from vsfsim.physics.rods.model import grow


@pytest.mark.parametrize("name", shelf.scenes())
def test_scene_builds(name: str) -> None:
    scene = load_scene(shelf.scenes()[name]).sample(0)
    assert scene.name == name
    if scene.object is None:
        # a sensor that just touches its obstacle, then goes on along its +z
        assert scene.sensor is not None and scene.press is not None and isinstance(scene.obstacles[0].shape, Sphere)
        apex = build_bubble(scene.sensor).mesh.points[:, 2].max()
        # the apex of the mesh that is finer at the tip is 0.02 mm lower than that of the even one
        assert scene.press.start[2] - apex - scene.obstacles[0].shape.radius == pytest.approx(0.0, abs=3e-5)
        return
    if scene.arm is not None:
        plant = grow(scene.object.shape, np.random.default_rng(0), where=name)
        assert scene.object.tier == "rod" and 50 <= len(plant.nodes) - 1 <= 600
        return
    solid = build_solid(scene.object, resolution=scene.object.resolution or 0.01, rng=np.random.default_rng(0))
    spec = scene.object
    material = spec.young_modulus.of_regions(solid.young_modulus, name)
    assert material is None or (material > 0).all()
    if not isinstance(spec.fixed, str):
        low, high = np.array(spec.fixed[:3]), np.array(spec.fixed[3:])
        held = ((solid.vertices >= low) & (solid.vertices <= high)).all(axis=1)
        assert 3 <= held.sum() < len(solid.vertices)
    if scene.press is not None and len(scene.press.path) == 2:  # straight down
        start, stop = np.array(scene.press.start), np.array(scene.press.stop)
        if scene.sensor is not None:
            # its first frames are in free air
            lowest, gap = start[2] - build_bubble(scene.sensor).mesh.points[:, 2].max(), 3e-3
        else:
            assert isinstance(scene.probe, (Sphere, Box, Plane))
            below = {Sphere: lambda p: p.radius, Box: lambda p: 0.5 * p.size[2], Plane: lambda p: 0.0}
            lowest, gap = start[2] - below[type(scene.probe)](scene.probe), 1e-9
        # The probe just touches the highest point under it (a bubble is a little above it), then goes in along -z.
        assert 0.0 <= lowest - solid.vertices[:, 2].max() + 1e-12 < gap
        assert stop[2] < start[2] and (stop[:2] == start[:2]).all()
