"""The local indentation on bodies that it was not fitted to: `vsfsim measure indentation`.

Balls of 6 to 16 mm are pressed at random places into random blocks of one material, over a stiff ball 0.3 to 3 mm under
the surface, or over a stiff layer, at each tier with and without the compliance. The reference is tier fem on elements
of a fifth of the ball's radius.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import Scene, parse_scene
from vsfsim.generate.press_result import PressRequest
from vsfsim.generate.presses.probe import prepare
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import body_poses, pose_at, press_path

SCENE = """
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ box = {box} }}
poisson_ratio = {nu}
young_modulus = {{ base = 1e5, inclusions = [{inside}] }}
{resolution}
[probe]
shape = {{ sphere = {radius} }}
[press]
from = {start}
to = {stop}
frames = 5
"""
BODIES = (1, 3)
"""Numbers of the bodies that pages tell of: one over a stiff ball, one of one material."""
TIERS = ("linear", "fem-coarse", "fem")
_KINDS = ("one material", "a stiff ball", "a stiff layer")


def scene_of(number: int, *, fine: bool = False) -> Scene:
    """Body ``number``, with the mesh of a press or the fine one."""
    rng = np.random.default_rng(100 + number)
    high = float(rng.uniform(0.02, 0.04))
    box = [*rng.uniform(0.05, 0.08, 2).tolist(), high]
    radius, inside = float(rng.uniform(0.006, 0.016)), ""
    x, y = rng.uniform(-0.01, 0.01, 2).tolist()
    if number % 3 == 1:
        ball, under = float(rng.uniform(0.2, 0.3) * high), float(rng.uniform(0.0003, 0.003))
        aside = rng.uniform(-0.8, 0.8, 2) * ball
        inside = (f"{{ sphere = {[float(v) for v in (x + aside[0], y + aside[1], high - ball - under, ball)]}, "
                  f"value = {float(10 ** rng.uniform(6, 7.5))} }}")
    elif number % 3 == 2:
        thick = float(rng.uniform(0.05, 0.12) * high)
        inside = (f"{{ box = {[-1.0, -1.0, high - 2.0 * thick, 1.0, 1.0, high - thick]}, "
                  f"value = {float(10 ** rng.uniform(5.5, 6.5))} }}")
    nu, depth = float(rng.choice([0.3, 0.45, 0.48])), float(rng.uniform(0.15, 0.3) * radius)
    return parse_scene(SCENE.format(
        box=box, nu=nu, inside=inside, radius=radius, start=[x, y, high + radius], stop=[x, y, high + radius - depth],
        resolution=f"resolution = {radius / 5.0}" if fine else ""), Path("indentation.toml")).sample(0)


def push(scene: Scene, tier: str, *, local: bool) -> np.ndarray:
    """Normal force in every frame (5,) [N]."""
    model = prepare(scene, PressRequest(tier=tier)).model
    assert scene.press is not None
    options = dataclasses.replace(tiers.options(tier), local_indentation=local)
    poses = body_poses(scene, press_path(scene.press, scene.probe))
    frames = Solver(model, scene.bodies, options=options, linear=not tiers.TIERS[tier].nonlinear).run(
        poses[:, None], start=body_poses(scene, pose_at(scene.press, scene.probe, 0)[None]))
    return frames.force[:, 0, 2]


def measure(bodies: Sequence[int] = BODIES, *, progress: Progress = lambda said: None) -> Measurement:
    """Errors of the force at five depths, of these ``bodies``."""
    rows = []
    for number in bodies:
        progress(f"body {number}: the fine mesh ...")
        exact = push(scene_of(number, fine=True), "fem", local=True)
        for tier in TIERS:
            for local in (True, False):
                progress(f"body {number}: {tier} ...")
                error = push(scene_of(number), tier, local=local) / exact - 1.0
                rows.append({"body": number, "kind": _KINDS[number % 3], "tier": tier, "local": "with" if local else
                             "without", "rms": float(np.sqrt((error**2).mean())),
                             **{f"e{k}": float(e) for k, e in enumerate(error)}})
    columns = (Column("body", "body", "1", form="d"), Column("kind", "kind"), Column("tier", "tier"),
               Column("local", "compliance"), *(Column(f"e{k}", f"{20 * (k + 1)} % of the depth", "1", "%", "+.1f")
                                                for k in range(5)), Column("rms", "rms", "1", "%", ".2f"))
    return Measurement.of("indentation", {"bodies": list(bodies)}, [
        Table("Error of the force on bodies that the compliance was not fitted to", columns, rows, "errors")])
