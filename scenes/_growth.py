"""What the two families of plants share: a tree of beams while it grows, segment by segment."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

_GOLDEN = 2.399963
"""The golden angle [rad]."""
_DIRECTION_SPREAD = 0.05
"""Standard deviation of the random change of an axis's direction per segment [rad]."""


class Growth:
    """Lists with one entry per node of the tree.

    Args:
        rng: random stream of the form.
        foot: the clamped node (3,) [m].
        radius: there [m].
    """

    def __init__(self, rng: np.random.Generator, foot: np.ndarray, radius: float):
        self.rng = rng
        self.nodes, self.parent, self.radius, self.half_width = [foot], [-1], [radius], [0.0]
        self.normal, self.modulus, self.region, self.axis = [np.zeros(3)], [1e9], [0], [0]

    def node(self, parent: int, place: np.ndarray, radius: float, region: int, modulus: float,
             axis: int, half_width: float = 0.0, normal: np.ndarray | None = None) -> int:
        """Add a segment from node ``parent`` to ``place`` (3,) [m]; the number of its node."""
        for column, value in ((self.nodes, place), (self.parent, parent), (self.radius, radius),
                              (self.half_width, half_width), (self.region, region),
                              (self.modulus, modulus), (self.axis, axis),
                              (self.normal, np.zeros(3) if normal is None else normal)):
            column.append(value)
        return len(self.nodes) - 1

    def drawn(self, span: tuple[float, float]) -> float:
        """A number within bounds, log-uniform."""
        return math.exp(self.rng.uniform(math.log(span[0]), math.log(span[1])))

    def stems(self, count: int, spread: float, lean: float,
              lift: float) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        """Direction (3,) of each of ``count`` stems, at most ``lean`` [rad] from upright, and where its foot is (3,)
        [m] if stems stand apart by ``spread`` [m], ``lift`` [m] over the clamped node."""
        for k in range(count):
            azimuth = k * _GOLDEN + self.rng.uniform(-0.3, 0.3)
            out = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            angle = lean * self.rng.uniform(0.5, 1.0)
            way = math.cos(angle) * np.array([0.0, 0.0, 1.0]) + math.sin(angle) * out
            place = self.nodes[0] + spread * math.sqrt((k + 0.5) / count) * out + [0.0, 0.0, lift]
            yield way, place if spread > 0.0 else None

    def step(self, at: int, way: np.ndarray, length: float, count: int,
             droop: float) -> tuple[np.ndarray, np.ndarray]:
        """One of ``count`` segments of an axis of a ``length`` [m]: its direction (3,), which varies a little from
        ``way`` and bends down by ``droop`` [1/m], and its end (3,) [m]."""
        way = way + self.rng.normal(0.0, _DIRECTION_SPREAD, 3) - [0.0, 0.0, droop * length / count]
        way = way / np.linalg.norm(way)
        return way, self.nodes[at] + length / count * way

    def branch(self, axis: list[int], place: float, turn: float, number: int, angle: float) -> tuple[int, np.ndarray]:
        """The node of an axis at a ``place``, a fraction of its length, and the direction (3,) there of its branch or
        leaf ``number``, about ``angle`` [rad] from the axis and at a multiple of the golden angle around it."""
        joint = axis[max(1, min(len(axis) - 1, round(place * (len(axis) - 1))))] if len(axis) > 1 else axis[0]
        azimuth, angle = turn + number * _GOLDEN, angle * self.rng.uniform(0.8, 1.2)
        along = self.nodes[joint] - self.nodes[self.parent[joint]]
        along = along / np.linalg.norm(along)
        side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        side /= np.linalg.norm(side)
        across = math.cos(azimuth) * side + math.sin(azimuth) * np.cross(along, side)
        return joint, math.cos(angle) * along + math.sin(angle) * across

    def blade(self, at: int, way: np.ndarray, length: float, droop: float,
              parts: int) -> Iterator[tuple[int, np.ndarray, np.ndarray, float]]:
        """The segments of a blade: node at its start, its end (3,) [m], its unit normal (3,), and its width over that
        of the blade. Each is to be added before the next is asked for."""
        for k in range(parts):
            way = way - np.array([0.0, 0.0, droop * length / parts])
            way = way / np.linalg.norm(way)
            place = self.nodes[at] + length / parts * way
            if place[2] < 0.02:
                return
            normal = np.array([0.0, 0.0, 1.0]) - way[2] * way
            if np.linalg.norm(normal) < 0.1:  # the normal of an upright blade is arbitrary
                normal = np.cross(way, np.array([1.0, 0.0, 0.0]))
            yield (at, place, normal / np.linalg.norm(normal),
                   math.sin(math.pi * (0.12 + 0.76 * (k + 0.5) / parts)))
            at = len(self.nodes) - 1
