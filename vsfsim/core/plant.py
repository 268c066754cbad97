"""A plant before any model is made of it: a tree of branches, petioles and leaf blades, standing in a pot."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.solid import Appearance
from vsfsim.core.system.exact import product


@dataclass(frozen=True)
class Pot:
    """A pot that stands on z = 0 under the origin, a truncated cone."""

    radius_top: float
    """Radius at the top [m]."""
    radius_bottom: float
    """Radius at the bottom [m]."""
    height: float
    """Of the pot [m]."""


@dataclass(frozen=True)
class Plant:
    """A tree of n nodes. Node 0 is clamped in the pot, and segment i (1 to n - 1) goes from node ``parent[i]`` to
    node i. Entry 0 of the arrays of segments is not read."""

    nodes: np.ndarray
    """Positions (n, 3) [m]."""
    parent: np.ndarray
    """Parent of each node (n,) int, smaller than the node's own number; -1 for node 0."""
    radius: np.ndarray
    """Of a round segment, or half the thickness of a leaf blade (n,) [m]."""
    half_width: np.ndarray
    """Of a blade; 0 for a round segment (n,) [m]."""
    blade_normal: np.ndarray
    """Unit normal of a blade at rest (n, 3)."""
    young_modulus: np.ndarray
    """Of each segment (n,) [Pa]."""
    density: np.ndarray
    """Of each segment (n,) [kg/m^3]."""
    region: np.ndarray
    """Of each segment, an index into `region_names` (n,)."""
    region_names: tuple[str, ...]
    """At least one."""
    poisson_ratio: float = 0.35
    """Of all segments [-]."""
    look: np.ndarray | None = None
    """Of each segment, an index into `appearance` (n,); None: its region."""
    appearance: Appearance | None = None
    """None for a plain grey."""
    pot: Pot | None = None
    """None for none."""
    notes: tuple[str, ...] = field(default=())
    """One sentence each."""
    wire: np.ndarray | None = None
    """Diameter of the steel core of each segment, 0 where it has none or stands for several (n,) [m]; None for a plant
    without wires."""
    yielding: np.ndarray | None = None
    """Bending stiffness E I of the core of each segment [N m^2] and the moment at which it yields [N m], both 0 for a
    segment that does not (n, 2); part of the segment's own E I. None for a plant that does not yield."""
    name: str = ""
    """What a person would call it, e.g. "orange-tree"; "" for none."""

    def __post_init__(self) -> None:
        n = len(self.nodes)
        if n < 2 or self.nodes.shape != (n, 3) or not np.isfinite(self.nodes).all():
            raise SceneError(f"plant: nodes have the shape {self.nodes.shape}; give at least two finite points (n, "
                             f"3) in metres.")
        for name in ("parent", "radius", "half_width", "young_modulus", "density", "region"):
            if getattr(self, name).shape != (n,):
                raise SceneError(f"plant: {name} has the shape {getattr(self, name).shape}; one value a node, "
                                 f"({n},), is wanted.")
        if self.blade_normal.shape != (n, 3):
            raise SceneError(f"plant: blade_normal has the shape {self.blade_normal.shape}; it must be ({n}, 3).")
        wrong = np.flatnonzero((self.parent[1:] < 0) | (self.parent[1:] >= np.arange(1, n))) + 1
        if len(wrong):
            raise SceneError(f"plant: the parent of node {wrong[0]} is {self.parent[wrong[0]]}; it must be a node "
                             f"before it, 0 to {wrong[0] - 1}.")
        checks = (("radius", self.radius, 1e-5, 1.0), ("young_modulus", self.young_modulus, 1.0, 1e13),
                  ("length of the segment", self.lengths(), 1e-5, 10.0))
        for name, value, low, high in checks:
            bad = np.flatnonzero(~((value[1:] >= low) & (value[1:] <= high))) + 1
            if len(bad):
                raise SceneError(f"plant: the {name} of segment {bad[0]} is {value[bad[0]]:g}; it must be from {low:g} "
                                 f"to {high:g}.")
        if (not (self.half_width[1:] >= 0.0).all() or not (self.density[1:] >= 0.0).all()
            or not 0.0 <= self.poisson_ratio < 0.5):
            raise SceneError("plant: half widths and densities must be 0 or more, and Poisson's ratio from 0 "
                             "to under 0.5.")
        if self.yielding is not None:
            self._check_yielding(self.yielding)
        along = (self.nodes[1:] - self.nodes[self.parent[1:]]) / self.lengths()[1:, None]
        blade = self.half_width[1:] > 0.0
        tilt = np.abs(np.einsum("ij,ij->i", along, self.blade_normal[1:]))[blade]
        size = np.linalg.norm(self.blade_normal[1:], axis=1)[blade]
        if blade.any() and not ((tilt < 1e-6) & (np.abs(size - 1.0) < 1e-6)).all():
            raise SceneError("plant: the normal of a blade must be a unit vector across its segment.")

    def _check_yielding(self, core: np.ndarray) -> None:
        if core.shape != (len(self.nodes), 2) or not (core[1:] >= 0.0).all() or not np.isfinite(core[1:]).all():
            raise SceneError(f"plant: yielding has the shape {core.shape}; give the bending stiffness of each core and "
                             f"its yield moment, ({len(self.nodes)}, 2) numbers of 0 or more.")
        second = np.where(self.half_width > 0.0, 4.0 / 3.0 * self.half_width * self.radius**3,
                          0.25 * np.pi * self.radius**4)
        over = np.flatnonzero(core[1:, 0] > (1.0 + 1e-9) * (self.young_modulus * second)[1:]) + 1
        if len(over):
            i = over[0]
            raise SceneError(f"plant: the core of segment {i} has a bending stiffness of {core[i, 0]:g} N m^2, more "
                             f"than the whole segment with {self.young_modulus[i] * second[i]:g}.")

    def lengths(self) -> np.ndarray:
        """Length of each segment (n,) [m]; 0 for entry 0."""
        out = np.zeros(len(self.nodes))
        out[1:] = np.linalg.norm(self.nodes[1:] - self.nodes[self.parent[1:]], axis=1)
        return out

    def turned(self, yaw: float) -> Plant:
        """The same plant turned by ``yaw`` [rad] about +z."""
        import dataclasses

        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return dataclasses.replace(self, nodes=product(self.nodes, turn.T),
                                   blade_normal=product(self.blade_normal, turn.T))
