"""Random presses of the trust map: what a user could write, at random places and on random paths.

Nothing stands at a node of a mesh or on a plane of symmetry but by chance. A cell is a seed and a number; the same two
give the same scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from vsfsim.core.rotation import rotation_vector
from vsfsim.core.scene import SceneFile, parse_scene
from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, ProbeShape, Sphere
from vsfsim.physics.contact import sdf
from vsfsim.robot.path import turn_to

TIERS = ("fem-coarse", "fem-coarse", "fem-coarse", "fem-coarse", "fem", "linear")
FOAMS = ("ff-leap", "midsole", "pe-foam", "poron-125")
Spot = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]
"""Draws a point (3,) [m] of an object's upper surface, and the normal there (3,) [-]."""
_CLEAR = 0.002  # way of the probe before it meets the object [m]


@dataclass(frozen=True)
class Press:
    """One press, written as a scene."""

    kinds: tuple[str, ...]
    """Object, inside, probe, path and what else there is: words that the report counts by."""
    tier: str
    """At which it is pressed."""
    text: str
    """The scene, with `{frames}` and `{resolution}` to be filled in."""
    frames: tuple[int, ...]
    """Of each part of the path."""
    coarse: float
    """Factor on the tier's element size [-]."""
    retract: int
    """Frames on the way back."""

    def scene(self, folder: Path, *, times: Sequence[int] = (), resolution: float | None = None) -> SceneFile:
        """The scene with so many ``times`` the frames of each part of the path (and of the way back, as of the first),
        on elements of this ``resolution`` [m], or of the tier's."""
        own, times = "" if resolution is None else f"resolution = {resolution!r}", times or [1] * len(self.frames)
        frames = [k * n for k, n in zip(times, self.frames, strict=True)]
        return parse_scene(self.text.replace("{resolution}", own).replace(
            "{frames}", f"frames = {frames}\nretract = {times[0] * self.retract}"), folder / "scene.toml")


def press(seed: int, number: int, folder: Path) -> Press:
    """Press ``number`` of a ``seed``; ``folder`` takes the mesh of a scan."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    shape, where, surface, high, far = _object(rng, folder)
    tier = str(rng.choice(TIERS))
    foam = tier != "linear" and rng.random() < 0.12
    inside, kind = ("", "one material") if foam else _inside(rng, where, high)
    stuff = (f'material = "{rng.choice(FOAMS)}"' if foam else
             f"poisson_ratio = {float(rng.choice([0.2, 0.3, 0.45, 0.48]))!r}\n"
             f"young_modulus = {{ base = {float(10 ** rng.uniform(4, 6))!r}{inside} }}")
    friction = float(rng.choice([0.0, 0.0, 0.4]))
    probe, body = _probe(rng, high)
    point, normal = surface(rng)
    tables, path = _path(rng, body, point, normal, high, tier)
    way, turns, parts, depth = tables
    frames = tuple(int(n) for n in rng.choice([1, 2, 4], size=parts))
    retract = int(frames[0]) if parts == 1 and rng.random() < 0.25 else 0
    # a round body stands on a point: its lower third is held
    held = f"fixed = {[-1.0, -1.0, -1.0, 1.0, 1.0, 0.3 * high]}" if where in ("ball", "scan") else ""
    wall = ""
    if rng.random() < 0.2:
        wall, path = _wall(far + 2e-4), f"{path}, wall"
    text = f"""
name = "trust"
description = "A press of the trust map"
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ {shape} }}
{held}
friction = {friction!r}
{stuff}
{{resolution}}
[probe]
shape = {{ {probe} }}
{wall}
[press]
path = {way}
rotation = {turns}
{{frames}}
"""
    # the reference of most meshes of tier fem would take minutes
    coarse = float(rng.uniform(1.2, 1.8)) if rng.random() < (0.6 if tier == "fem" else 0.25) else 1.0
    kinds = (where, "foam" if foam else kind, probe.split(" ")[0], path + (", back" if retract else ""),
             f"mu {friction:g}", "coarse" if coarse > 1.0 else "default mesh", tier, f"depth {depth:.2f}")
    return Press(kinds, tier, text, frames, coarse, retract)


def _object(rng: np.random.Generator, folder: Path) -> tuple[str, str, Spot, float, float]:
    """Shape in TOML, its kind, a function that draws a point (3,) of its upper surface with the normal, its height and
    its half width along x [m]."""
    kind = str(rng.choice(["box", "box", "ball", "cylinder", "plate", "scan"]))
    if kind in ("box", "plate"):
        a, b = rng.uniform(0.03, 0.07, 2)
        c = float(rng.uniform(0.004, 0.008) if kind == "plate" else rng.uniform(0.012, 0.04))

        def on_box(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
            return np.array([*(rng.uniform(-0.4, 0.4, 2) * (a, b)), c]), np.array([0.0, 0.0, 1.0])

        return f"box = {[float(a), float(b), c]}", kind, on_box, c, 0.5 * float(a)
    if kind == "cylinder":
        r, c = (float(rng.uniform(0.015, most)) for most in (0.03, 0.04))

        def on_end(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
            angle, way = rng.uniform(0, 2 * np.pi), 0.75 * r * np.sqrt(rng.random())
            return np.array([way * np.cos(angle), way * np.sin(angle), c]), np.array([0.0, 0.0, 1.0])

        return f"cylinder = {[r, c]}", kind, on_end, c, r
    r = float(rng.uniform(0.02, 0.035))

    def on_ball(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        height, angle = rng.uniform(0.4, 1.0), rng.uniform(0, 2 * np.pi)
        n = np.array([*(np.sqrt(1 - height**2) * np.array([np.cos(angle), np.sin(angle)])), height])
        return r * n + [0.0, 0.0, r], n

    if kind == "ball":
        return f"sphere = {r!r}", kind, on_ball, 2.0 * r, r
    scan = trimesh.creation.icosphere(subdivisions=3, radius=r)
    scan.apply_scale([1.3, 1.0, 0.8])
    scan.apply_translation([0.0, 0.0, 0.8 * r])
    scan.export(folder / "scan.stl")

    def on_scan(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        p, n = on_ball(rng)
        at = (p - [0.0, 0.0, r]) * [1.3, 1.0, 0.8] + [0.0, 0.0, 0.8 * r]
        n = n / [1.3, 1.0, 0.8]
        return at, n / np.linalg.norm(n)

    return 'mesh = "scan.stl"', kind, on_scan, 1.6 * r, 1.3 * r


def _inside(rng: np.random.Generator, where: str, high: float) -> tuple[str, str]:
    """Inclusions in TOML, and their kind."""
    kind = str(rng.choice(["one material", "one material", "ball", "several", "layer", "skin", "plate"]))
    if kind == "one material" or where == "scan":
        return "", "one material"
    def stiff() -> float:
        return float(10 ** rng.uniform(4, 6) * 10 ** rng.uniform(-1.5, 3))

    parts = []
    if kind in ("ball", "several"):
        for _ in range(1 if kind == "ball" else int(rng.integers(2, 5))):
            r = rng.uniform(0.1, 0.3) * high
            at = [*rng.uniform(-0.015, 0.015, 2), rng.uniform(r, high - r)]
            if rng.random() < 0.3:
                to = [at[0] + 0.01, at[1] + rng.uniform(-0.005, 0.005), at[2]]
                parts.append(f"capsule = {[float(v) for v in (*at, *to, 0.5 * r)]}")
            else:
                parts.append(f"sphere = {[float(v) for v in (*at, r)]}")
    else:
        thick = rng.uniform(0.03, 0.15) * high
        low = {"layer": rng.uniform(0.2, 0.8) * high, "skin": high - thick, "plate": rng.uniform(0.4, 0.8) * high}[kind]
        size = rng.uniform(0.008, 0.02, 2) if kind == "plate" else (1.0, 1.0)
        parts.append(f"box = {[float(v) for v in (-size[0], -size[1], low, *size, low + thick)]}")
    rows = ", ".join(f"{{ {part}, value = {stiff()!r} }}" for part in parts)
    return f", inclusions = [ {rows} ]", kind


def _probe(rng: np.random.Generator, high: float) -> tuple[str, ProbeShape]:
    r = float(np.exp(rng.uniform(np.log(0.003), np.log(0.02))))
    kind = str(rng.choice(["sphere", "sphere", "capsule", "box", "cylinder", "plane"]))
    if kind == "plane":
        return "plane = true", Plane()
    if kind == "sphere":
        return f"sphere = {r!r}", Sphere(r)
    long = float(rng.uniform(1.0, 3.0) * r)
    if kind == "box":
        return f"box = {[2 * r, 2 * r, long]}", Box((2 * r, 2 * r, long))
    if kind == "cylinder":
        return f"cylinder = {[r, long]}", Cylinder(r, long)
    return f"capsule = {[0.5 * r, long]}", Capsule(0.5 * r, long)


def _path(rng: np.random.Generator, body: ProbeShape, point: np.ndarray, normal: np.ndarray, high: float,
          tier: str) -> tuple[tuple[list[list[float]], list[list[float]], int, float], str]:
    """Corner points, rotations, number of parts and depth of the path, and its kind."""
    tilt = np.deg2rad(rng.uniform(0.0, 25.0))
    across = np.cross(normal, [np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle), 0.3])
    across /= np.linalg.norm(across)
    axis = -np.cos(tilt) * normal + np.sin(tilt) * across
    flat = isinstance(body, Plane)
    turn = turn_to(-normal if flat else axis, body)
    share = rng.uniform(0.03, 0.1 if tier == "linear" else 0.3)
    most = 1e9 if flat else 1.5 * float(sdf.reach(body))
    depth = float(min(share * high, most))
    # the probe just meets the tangent plane at the point
    contact = point + normal * float(sdf.support(body, turn.T @ -normal))
    axis = -normal if flat else axis
    start, stop = contact - _CLEAR * axis / max(0.3, float(-axis @ normal)), contact + depth * axis
    first = rotation_vector(turn)
    kind = str(rng.choice(["press", "press", "slide", "turn"]))
    if flat or kind == "press":
        return ([start.tolist(), stop.tolist()], [first.tolist()] * 2, 1, depth / high), "press"
    if kind == "slide":
        end = stop + rng.uniform(0.5, 2.0) * depth * across
        return ([start.tolist(), stop.tolist(), end.tolist()], [first.tolist()] * 3, 2, depth / high), "slide"
    last = (Rotation.from_rotvec(np.deg2rad(rng.uniform(10, 30)) * across)
            * Rotation.from_matrix(turn)).as_rotvec()
    return ([start.tolist(), stop.tolist(), stop.tolist()], [first.tolist(), first.tolist(), last.tolist()], 2,
            depth / high), "turn"


def _wall(far: float) -> str:
    """A rigid wall beside the object, which leans on it when it bulges: at x = ``far`` [m]."""
    return (f"[[obstacles]]\nshape = {{ plane = true }}\npose = {[far, 0.0, 0.0]}\n"
            f"rotation = {[0.0, -0.5 * np.pi, 0.0]}\n")
