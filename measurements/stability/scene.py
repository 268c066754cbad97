"""The scene file of a cell."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from measurements.stability.design import Cell
from vsfsim.core.scene import SceneFile, parse_scene
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import build_bubble

PROBE_SIZE = 0.2  # radius of the ball over the block's width
DENSITY = 1000.0  # of the block [kg/m^3]
_TURN = np.pi / 4.0
_CORNER = [np.arccos(-np.sqrt(1.0 / 3.0)) * c for c in (np.sqrt(0.5), np.sqrt(0.5), 0.0)]
"""Rotation vector [rad] that turns the corner (1, -1, 1) of a cube downwards, and the opposite one upwards."""


def solid_scene(cell: Cell, folder: Path) -> tuple[SceneFile, str]:
    """The scene of a solid and its tier; ``folder`` takes the mesh of the pyramid.

    Raises:
        SceneError: the scene cannot be built, which a cell of the design must not cause.
    """
    f = cell.factors
    width = float(f["size"])
    high = width * float(f["thickness"])
    inside = ""
    if f["contrast"] != 1.0:
        inside = (f", inclusions = [ {{ sphere = [{0.15 * width!r}, 0.0, {0.6 * high!r}, "
                  f"{0.25 * min(high, width)!r}], value = {float(f['young']) * float(f['contrast'])!r} }} ]")
    probe, start, rest = _probe(str(f["probe"]), width, high, folder)
    stop = start - float(f["depth"]) * high

    def text(resolution: str) -> str:
        return f"""
name = "stability"
description = "A cell of the stability map"
needs = ["contact"]
gravity = [0.0, 0.0, {-solid_gravity(f)!r}]
[object]
shape = {{ box = [{width!r}, {width!r}, {high!r}] }}
fixed = "bottom"
friction = {float(f['friction'])!r}
density = {DENSITY!r}
poisson_ratio = {float(f['poisson'])!r}
young_modulus = {{ base = {float(f['young'])!r}{inside} }}
{resolution}
{probe}
[press]
from = [0.0, 0.0, {start!r}]
to = [0.0, 0.0, {stop!r}]
frames = {int(f['frames'])}
{rest}
"""

    path, tier = folder / "scene.toml", str(f["tier"])
    scene = parse_scene(text(""), path)
    if f["element"] != 1.0:
        sample = scene.sample(0)
        edge = float(f["element"]) * tiers.element_size(sample.object, tier, sample.probe)
        edge = min(max(edge, 1e-5), 1.0)  # what a scene may say
        scene = parse_scene(text(f"resolution = {edge!r}"), path)
    return scene, tier


def solid_gravity(factors: Mapping[str, float | str]) -> float:
    """Gravity of a solid [m/s^2]. A block whose weight presses with more than Young's modulus on its base is crushed
    before anything touches it, and has no state at rest: it is asked for a fifth of that modulus instead, under which
    it still stands high enough to be touched."""
    most = float(factors["young"]) / (DENSITY * float(factors["size"]) * float(factors["thickness"]))
    asked = float(factors["gravity"])
    return asked if asked <= most else 0.2 * most


def _probe(name: str, width: float, high: float, folder: Path) -> tuple[str, float, str]:
    """Tables of the probe, height of its origin when it touches the block's top [m], and keys of [press]."""
    r = PROBE_SIZE * width
    small, edge, straight = 0.2 * r, 1.5 * r, [0.0, 0.0, 0.0]
    ball, cube = f"sphere = {r!r}", f"box = [{edge!r}, {edge!r}, {edge!r}]"
    capsule = f"capsule = [{0.5 * r!r}, {2 * r!r}]"
    shape, above, turn = {
        "ball": (ball, r, straight), "fork": (ball, r, straight), "ball and wall": (ball, r, straight),
        "small ball": (f"sphere = {small!r}", small, straight),
        "box": (cube, 0.5 * edge, straight), "box edge": (cube, np.sqrt(0.5) * edge, [_TURN, 0.0, 0.0]),
        "box corner": (cube, np.sqrt(0.75) * edge, _CORNER),
        "cylinder": (f"cylinder = [{r!r}, {edge!r}]", 0.5 * edge, straight),
        "cylinder rim": (f"cylinder = [{r!r}, {2 * r!r}]", np.sqrt(0.5) * (r + r), [_TURN, 0.0, 0.0]),
        "capsule": (capsule, 0.5 * r, [2 * _TURN, 0.0, 0.0]), "capsule end": (capsule, 1.5 * r, straight),
        "plane": ("plane = true", 0.0, [4 * _TURN, 0.0, 0.0]),
        "pyramid": ('mesh = "pyramid.obj"', 0.5 * edge, straight)}[name]
    if name == "pyramid":
        write_pyramid(folder / "pyramid.obj", edge)
    tables = f"[probe]\nshape = {{ {shape} }}\n"
    if name == "fork":  # a thin pin in front of the ball
        tables += f"[[probe.parts]]\nshape = {{ sphere = {small!r} }}\noffset = [{r!r}, {r!r}, {small - r!r}]\n"
    if name == "ball and wall":  # the wall touches the side of the block
        tables += (f"[[obstacles]]\nshape = {{ plane = true }}\npose = [{0.5 * width!r}, 0.0, 0.0]\n"
                   f"rotation = [0.0, {-2 * _TURN!r}, 0.0]\n")
    return tables, float(high + above), f"rotation = {[float(v) for v in turn]}"


def write_pyramid(path: Path, edge: float) -> None:
    """Write a square pyramid as OBJ, its tip down; base and height are ``edge`` [m]."""
    corners = [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1), (0, 0, -1)]
    faces = ((1, 2, 3), (1, 3, 4), (2, 1, 5), (3, 2, 5), (4, 3, 5), (1, 4, 5))
    path.write_text("".join([*(f"v {0.5 * edge * x!r} {0.5 * edge * y!r} {0.5 * edge * z!r}\n" for x, y, z in corners),
                             *(f"f {a} {b} {c}\n" for a, b, c in faces)]))


def bubble_scene(cell: Cell, folder: Path) -> SceneFile:
    """The scene of a bubble.

    Raises:
        SceneError: the scene cannot be built.
    """
    f = cell.factors
    frames = int(f["frames"])
    sensor = (f'[sensor]\nkind = "bubble"\nnodes = {int(f["nodes"])}\ngauge_pressure = {float(f["gauge"])!r}\n'
              f'pre_stretch = {float(f["stretch"])!r}\n')
    free = parse_scene(f'name = "free"\n{sensor}[[obstacles]]\nshape = {{ sphere = 0.01 }}\npose = [0.0, 0.0, 0.0]\n',
                       folder / "free.toml").sample(0)
    apex = float(build_bubble(free.required_sensor, where="the stability map").mesh.points[:, 2].max())
    against = str(f["against"])
    depth = float(f["depth"]) * apex
    bodies = {"tip": ("capsule = [0.003, 0.06]", 0.033, [0.0] * 3), "small ball": ("sphere = 0.003", 0.003, [0.0] * 3),
              "ball": ("sphere = 0.02", 0.02, [0.0] * 3), "plane": ("plane = true", 0.0, [0.0] * 3),
              "box corner": ("box = [0.03, 0.03, 0.03]", np.sqrt(0.75) * 0.03, _CORNER),
              "box edge": ("box = [0.06, 0.03, 0.03]", np.sqrt(0.5) * 0.03, [_TURN, 0.0, 0.0]),
              "cylinder rim": ("cylinder = [0.02, 0.04]", 0.02, [0.0] * 3)}
    block = against in ("soft block", "block")
    if block:
        young, top = 1e3 if against == "soft block" else 1e5, 0.05
        what = (f"[object]\nshape = {{ box = [0.1, 0.1, 0.05] }}\npoisson_ratio = 0.45\nyoung_modulus = {young!r}\n"
                f"resolution = 0.012\n")
    else:
        shape, top, turn = bodies[against]
        aside = 0.02 if against == "cylinder rim" else 0.0  # its rim is under the dome's axis
        what = (f"[[obstacles]]\nshape = {{ {shape} }}\npose = [{aside!r}, 0.0, 0.0]\n"
                f"rotation = {[float(v) for v in turn]}\nfriction = {float(f['friction'])!r}\n")
    start, low = float(top + apex + 0.001), float(top + apex - depth)
    path, turns, counts = [[0.0, 0.0, start], [0.0, 0.0, low]], [[np.pi, 0.0, 0.0]] * 2, [frames]
    if f["move"] == "drag":
        path, turns, counts = [*path, [0.01, 0.0, low]], [[np.pi, 0.0, 0.0]] * 3, [frames, 2 * frames]
    elif f["move"] == "twist":
        # half a turn about an axis in the plane that is turned by half of the twist: down, and twisted
        half = np.radians(22.5)
        last = [float(np.pi * np.cos(half)), float(np.pi * np.sin(half)), 0.0]
        path, turns, counts = [*path, [0.0, 0.0, low]], [[np.pi, 0.0, 0.0], [np.pi, 0.0, 0.0], last], [frames,
                                                                                                      2 * frames]
    friction = f"friction = {float(f['friction'])!r}\n" if block else ""
    text = f"""
name = "stability"
description = "A cell of the stability map"
gravity = [0.0, 0.0, 0.0]
{what}
{sensor}{friction}
[press]
path = {path}
rotation = {[[float(v) for v in t] for t in turns]}
frames = {counts}
"""
    return parse_scene(text, folder / "scene.toml")
