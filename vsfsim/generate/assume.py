"""Defaults of a press where the scene has no probe or no path; each is reported to the user in a sentence."""

from __future__ import annotations

import dataclasses

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.rigid import PressSpec
from vsfsim.core.scene import Scene
from vsfsim.core.shape import Family, MeshFile, Sphere, extent
from vsfsim.generate.aim import clearance
from vsfsim.physics.contact import sdf
from vsfsim.physics.model import Model
from vsfsim.robot.path import turn_to

RADIUS = 0.2  # of the default probe over the object's smallest edge [-]: it indents, and the mesh resolves it
LARGEST_RADIUS = 0.02  # of the default probe [m]
DEPTH = 0.1  # of the default press over the object's height [-]
BLUNT = 0.5  # of the default press over the probe's radius, at most [-]: deeper, a ball's equator meets the body
FRAMES = 10  # of the default press
DOWN = np.array([0.0, 0.0, -1.0])


def with_probe(scene: Scene) -> tuple[Scene, list[str]]:
    """The scene with a probe that suits the object's size, if the file has none, and what was assumed."""
    if "probe" in scene.given:
        return scene, []
    shape, radius = scene.required_object.shape, LARGEST_RADIUS
    # A path is made for a certain probe: the default one of the scene format.
    if scene.press is None and not isinstance(shape, Family):
        if isinstance(shape, MeshFile):
            from vsfsim.physics.mesh.repair import read_surface  # imports trimesh

            size = read_surface(shape).extents
        else:
            size = np.array(extent(shape))
        radius = min(LARGEST_RADIUS, float(f"{RADIUS * size.min():.2g}")) or LARGEST_RADIUS
    return dataclasses.replace(scene, probe=Sphere(radius)), [
        f"No [probe] is given: a ball of {1e3 * radius:.3g} mm radius was taken."]


def with_press(scene: Scene, model: Model) -> tuple[Scene, list[str]]:
    """The scene with a press from above at the middle, if the file has none, and what was assumed.

    Raises:
        SceneError: the probe does not meet the body from above.
    """
    if scene.press is not None:
        return scene, []
    points = model.mesh.points
    low, high = points.min(axis=0), points.max(axis=0)
    pose = np.eye(4)
    pose[:3, :3] = turn_to(DOWN, scene.probe)
    above = sdf.support(scene.probe, pose[:3, :3].T @ DOWN)
    middle = 0.5 * (low + high)
    where = "at the middle"
    for place in (middle, points[points[:, 2].argmax()]):
        pose[:3, 3] = [place[0], place[1], high[2] + above + 0.01 * (high[2] - low[2])]
        gap = clearance(model, scene.probe, pose, DOWN)
        if np.isfinite(gap) and pose[2, 3] - gap - above > low[2]:
            break
        where = "at its highest point (from above, the middle is empty)"
    else:
        raise SceneError(f"{scene.source}: there is no [press], and a probe that comes from above meets nothing; add "
                         f"from and to, world coordinates of the probe's centre in metres.")
    height = float(high[2] - low[2])
    room = min(DEPTH * height, BLUNT * min(sdf.reach(scene.probe), height))
    depth = float(f"{room:.2g}")
    start = pose[:3, 3] + gap * DOWN
    stop = start + depth * DOWN
    (a, b, c), (x, y, z) = map(float, start), map(float, stop)
    spec = PressSpec(((a, b, c), (x, y, z)), (FRAMES,))
    note = (f"No [press] is given: the probe goes from above, {where}, from first contact at "
            f"({', '.join(f'{v:.4g}' for v in start)}) m, {1e3 * depth:.3g} mm deep, "
            f"{100 * depth / height:.2g} % of the height, in {FRAMES} frames.")
    return dataclasses.replace(scene, press=spec), [note]
