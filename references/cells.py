"""The presses whose forces `references/presses.py` computes, and each as a scene that `vsfsim measure trust` asks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

FRAMES = 5
"""Depths of a press, in equal parts of the deepest."""
BASE = 1e5
"""Young's modulus of a body, but of its parts and of foams [Pa]."""
FOAMS = {"ff-leap": ((1.718e5, 8.39, 0.0), (1.82e4, -1.04, 0.0)),
         "pe-foam": ((8.72e4, 7.71, 0.076), (1.43e4, 0.465, 0.423))}
"""Of each foam mu [Pa], alpha and beta of every term of `references/hyperfoam.py`."""
HELD = 0.3
"""Part of the height up to which a ball is held [-]."""
_LONG = 0.02  # height of a probe that has no radius along z [m]


@dataclass(frozen=True)
class Cell:
    """One press: a body on its base, or a ball held up to `HELD`, under a probe that goes straight down."""

    body: tuple[Any, ...]
    """("box", x, y, z), ("cylinder", radius, height) or ("sphere", radius) [m]."""
    probe: tuple[Any, ...]
    """("sphere", radius), ("cylinder", radius), ("plane",), ("capsule", radius, length along y), ("box", x, y) [m]."""
    depth: float
    """Deepest [m]."""
    nu: float = 0.45
    """Poisson's ratio [-]."""
    foam: str = ""
    """Name of a foam of `FOAMS`; empty for the neo-Hookean law."""
    at: float = 0.0
    """Place of the probe's axis along x [m]."""
    parts: tuple[tuple[Any, ...], ...] = ()
    """Each with its modulus over `BASE`, last: ("layer", low, high, .), ("sphere", x, z, radius, .), or
    ("box", x0, y, z0, x1, z1, .), which goes from -y to y [m]."""

    @property
    def high(self) -> float:
        """Top of the body [m]."""
        return 2.0 * self.body[1] if self.body[0] == "sphere" else self.body[-1]

    @property
    def radius(self) -> float:
        """Of the contact at the deepest, about [m]."""
        if self.probe[0] in ("cylinder", "box"):
            return self.probe[1] * (1.0 if self.probe[0] == "cylinder" else 0.5)
        curved = sum(1.0 / one[1] for one in (self.body, self.probe) if one[0] in ("sphere", "capsule"))
        return float(np.sqrt(self.depth / curved))

    def kinds(self) -> tuple[str, ...]:
        """Words that a report counts by: body, inside, probe and law."""
        inside = "one material" if not self.parts else "layers" if self.parts[0][0] == "layer" else "a part"
        thin = " plate" if self.body[0] != "sphere" and self.high < 0.01 else ""
        return (self.body[0] + thin, inside, f"probe: {self.probe[0]}", "foam" if self.foam else f"nu {self.nu:g}")

    def scene(self, *, resolution: float | None = None, mesh: str = "", slide: bool = False, times: int = 1) -> str:
        """The scene in TOML.

        Args:
            resolution: element size [m]; None for the tier's own.
            mesh: a file that has the body's surface, in place of its shape.
            slide: begin 4 mm aside along x, at the full depth of the first frame that slides.
            times: frames for each of the `FRAMES` depths.
        """
        kind, *sizes = self.body
        shape = f'mesh = "{mesh}"' if mesh else f"{kind} = {sizes if kind != 'sphere' else sizes[0]}"
        held = f"fixed = [-1.0, -1.0, -1.0, 1.0, 1.0, {HELD * self.high}]" if kind == "sphere" else ""
        x = 0.5 * self.body[1] if kind == "box" else self.body[1]
        inside = []
        for name, *numbers, ratio in self.parts:
            if name == "layer":
                name, where = "box", [-1.0, -1.0, numbers[0], 1.0, 1.0, numbers[1]]
            elif name == "sphere":
                where = [numbers[0], 0.0, *numbers[1:]]
            else:
                where = [numbers[0], -numbers[1], numbers[2], numbers[3], numbers[1], numbers[4]]
            inside.append(f"{{ {name} = {where}, value = {ratio * BASE} }}")
        stuff = (f'material = "{self.foam}"' if self.foam else f"poisson_ratio = {self.nu}\nyoung_modulus = "
                 f"{{ base = {BASE}, inclusions = [{', '.join(inside)}] }}")
        body, *p = self.probe
        probe, up, turn = {"sphere": lambda: (f"sphere = {p[0]}", p[0], [0.0, 0.0, 0.0]),
                           "cylinder": lambda: (f"cylinder = {[p[0], _LONG]}", 0.5 * _LONG, [0.0, 0.0, 0.0]),
                           "plane": lambda: ("plane = true", 0.0, [np.pi, 0.0, 0.0]),
                           "capsule": lambda: (f"capsule = {p}", p[0], [0.5 * np.pi, 0.0, 0.0]),
                           "box": lambda: (f"box = {[*p, _LONG]}", 0.5 * _LONG, [0.0, 0.0, 0.0])}[body]()
        top, size = self.high + up, "" if resolution is None else f"resolution = {resolution}"
        aside = self.at + (0.004 if self.at + 0.004 + self.radius < x else -0.004)
        path = [[self.at, 0.0, top], [self.at, 0.0, top - self.depth]]
        frames = [FRAMES * times]
        if slide:
            path = [[aside, 0.0, top], [aside, 0.0, top - self.depth], path[1]]
            frames = [times, 2 * times]
        return f"""
name = "trust"
description = "A press of known force"
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ {shape} }}
{held}
{size}
{stuff}
[probe]
shape = {{ {probe} }}
[press]
path = {path}
rotation = {[turn] * len(path)}
frames = {frames}
"""


def _table() -> tuple[Cell, ...]:
    block, wide, ball = ("box", 0.1, 0.1, 0.05), ("cylinder", 0.06, 0.03), ("sphere", 0.025)
    twenty, ten, five = ("sphere", 0.02), ("sphere", 0.01), ("sphere", 0.005)
    stiff, soft = 30.0, 0.1
    return (
        Cell(block, twenty, 0.005),  # S1
        *(Cell(wide, probe, depth, nu) for nu in (0.0, 0.3, 0.45, 0.49)
          for probe, depth in ((twenty, 0.005), (twenty, 0.001), (ten, 0.004), (five, 0.002))),
        *(Cell(wide, probe, 0.004, foam=foam) for probe in (twenty, ten) for foam in FOAMS),
        Cell(wide, twenty, 0.001, foam="pe-foam"),
        *(Cell(("cylinder", 0.03, high), probe, depth, 0.3) for high in (0.006, 0.012)
          for probe, depth in ((twenty, 0.15 * high), (ten, 0.25 * high))),
        *(Cell(wide, ("cylinder", r), 0.003, nu) for r in (0.008, 0.015) for nu in (0.3, 0.45)),
        *(Cell(ball, probe, depth, nu) for probe, depth in ((("plane",), 0.002), (("plane",), 0.005), (ten, 0.003),
                                                            (twenty, 0.001)) for nu in (0.3, 0.45)),
        Cell(ball, ("plane",), 0.004, foam="ff-leap"),
        *(Cell(wide, probe, 0.003, parts=(("layer", low, up, ratio),)) for probe in (twenty, ten)
          for low, up, ratio in ((0.027, 0.03, stiff), (0.02, 0.025, stiff), (0.0, 0.02, stiff), (0.025, 0.03, soft))),
        *(Cell(wide, probe, 0.003, parts=(("sphere", 0.0, z, r, ratio),)) for probe in (twenty, ten)
          for z, r, ratio in ((0.02, 0.007, stiff), (0.015, 0.01, stiff), (0.018, 0.008, soft))),
        *(Cell(("box", 0.06, 0.05, 0.03), probe, 0.003, nu, at=at) for probe in (twenty, ten, ("capsule", 0.006, 0.012))
          for nu, at in ((0.3, 0.0), (0.45, 0.013))),
        Cell(("box", 0.06, 0.05, 0.03), ("box", 0.016, 0.016), 0.002, 0.3),
        Cell(("box", 0.06, 0.05, 0.008), ten, 0.002, 0.3, at=0.01),
        *(Cell(("box", 0.06, 0.05, 0.03), ten, 0.003, 0.3, at=at,
               parts=(("box", 0.0, 0.01, 0.012, 0.016, 0.022, ratio),))
          for at, ratio in ((0.004, stiff), (0.016, stiff), (0.008, soft))),
        Cell(("box", 0.06, 0.05, 0.03), twenty, 0.003, foam="pe-foam", at=0.012))


CELLS = _table()
"""All presses."""
