"""What must not change a force: scale, turn, mirror, the order of parts, the number of frames; with friction, at every
tier.

A frame is balanced to the tolerance of its tier, up to which displacements are known; the force is known to five times
that. Two presses of bodies that are the same but for rounding agree as far. With friction, and under a body with edges,
whose contact points are made on the way, the number of frames may change a force by 3 %.
"""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
from frame_checks import some_slow
from scipy.spatial.transform import Rotation
from texts import scene

from vsfsim.physics.tiers import TIERS
from vsfsim.press.command import press

SLANTED = ((-0.004, 0.002, 0.041), (0.002, 0.005, 0.036))
DOWN = ((0.006, 0.004, 0.041), (0.006, 0.004, 0.036))
HALF = (DOWN[0], (0.006, 0.004, 0.038))
LOWER = ((0.006, 0.004, 0.0405), (0.006, 0.004, 0.0375))
HIGHER = tuple((x, y, z + 0.008) for x, y, z in DOWN)
PARTS = (("sphere", 0.02, 0.0, 0.012, 0.008, 1e6), ("sphere", -0.015, 0.01, 0.02, 0.007, 1e4))
LAYER = (("box", -0.1, -0.1, 0.015, 0.1, 0.1, 0.1, 1e4),)


@dataclass(frozen=True)
class Case:
    """A body, by default a block of 60 x 50 x 30 mm, under a ball of 10 mm by default."""

    tier: str
    path: tuple = DOWN
    friction: float = 0.0
    probe: tuple = ("sphere", 0.01)
    parts: tuple = ()
    weight: float = 0.0
    body: tuple = ("box", 0.06, 0.05, 0.03)


CASES = {
    "linear": Case("linear"), "linear, friction": Case("linear", SLANTED, 0.5),
    "coarse, friction": Case("fem-coarse", SLANTED, 0.5), "fem, friction": Case("fem", SLANTED, 0.5),
    "fine, friction": Case("fem-fine", SLANTED, 0.5), "layer": Case("fem-coarse", SLANTED, parts=LAYER),
    "parts": Case("fem-coarse", SLANTED, parts=PARTS),
    "capsule": Case("fem-coarse", HIGHER, probe=("capsule", 0.008, 0.02)),
    "capsule, friction": Case("fem-coarse", HIGHER, 0.5, ("capsule", 0.008, 0.02)),
    "punch": Case("linear", LOWER, probe=("box", 0.02, 0.016, 0.02)),
    "heavy": Case("fem-coarse", weight=5.0), "ball": Case("fem-coarse", HALF, body=("sphere", 0.016)),
    "column, friction": Case("linear", SLANTED, 0.5, body=("cylinder", 0.03, 0.03)),
}
EACH = pytest.mark.parametrize("name", some_slow(
    CASES, *CASES.keys() - {"linear", "linear, friction", "coarse, friction", "heavy"}))
ROUND = ("ball", "column, friction")
"""Bodies whose mesh is not its own mirror image: a coarse column is off by 4 %."""


@functools.cache
def force(name, *, scale=1.0, modulus=1.0, turn=0.0, mirror=1.0, order=1, frames=1):
    """At full depth (3,) [N]."""
    c, spin = CASES[name], Rotation.from_rotvec([0.0, 0.0, turn])
    path = (scale * spin.apply(np.array(c.path) * [mirror, 1.0, 1.0])).tolist()

    def table(kind, *size, **more):
        values = {kind: [scale * v for v in size] if len(size) > 1 else scale * size[0], **more}
        return f"{{ {', '.join(f'{key} = {value!r}' for key, value in values.items())} }}"

    parts = ", ".join(table(kind, x if kind == "box" else mirror * x, *rest, value=modulus * value)
                      for kind, x, *rest, value in c.parts[::order])
    block = scene("block", needs=[], gravity=[0.0, 0.0, -c.weight], resolution=0.015 * scale, yaw=turn,
                  shape=table(*c.body), tier=f'"{c.tier}"', fixed=[scale * v for v in (-1, -1, -1, 1, 1, 0.004)],
                  poisson_ratio=0.4, density=1000.0 * modulus / scale, friction=c.friction,
                  young_modulus=f"{{ base = {1e5 * modulus}, inclusions = [{parts}] }}",
                  probe=f"{{ shape = {table(*c.probe)} }}", press=f"""\
{{ path = {path}, rotation = [0.0, 0.0, {turn}], frames = {frames} }}""")
    made = press(block)
    assert made.converged, made.text()
    return made.force[-1]


def same(name, found, share=None):
    """Whether a force is that of a case, to a ``share`` [-] of it."""
    wanted = force(name)
    off = float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
    return off < (5.0 * TIERS[CASES[name].tier].tolerance if share is None else share)


@EACH
def test_scale_modulus_turn_mirror_and_order_of_parts(name):
    mirror = 1.0 if name in ROUND else -1.0
    found = force(name, scale=1.7, modulus=3.0, turn=0.7, mirror=mirror, order=-1) / (3.0 * 1.7**2)
    back = Rotation.from_rotvec([0.0, 0.0, -0.7]).apply(found) * [mirror, 1.0, 1.0]
    assert np.linalg.norm(force(name)) > 0.05 and same(name, back)


@EACH
def test_number_of_frames(name):
    way = CASES[name].friction or CASES[name].probe[0] == "box"
    assert same(name, force(name, frames=3), 0.03 if way else None)
