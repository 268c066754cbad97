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
        shapes: dict[str, tuple[int, ...]] = {"nodes": (n, 3), "blade_normal": (n, 3), **dict.fromkeys(
            ("parent", "radius", "half_width", "young_modulus", "density", "region"), (n,))}
        if self.yielding is not None:
            shapes["yielding"] = (n, 2)
        for name, shape in shapes.items():
            if n < 2 or getattr(self, name).shape != shape or not np.isfinite(self.nodes).all():
                raise SceneError(f"plant: {name} has the shape {getattr(self, name).shape}; give finite values of the "
                                 f"shape {shape}, for two nodes or more.")
        second = np.where(self.half_width > 0.0, 4.0 / 3.0 * self.half_width * self.radius**3,
                          0.25 * np.pi * self.radius**4)
        core = np.zeros((n, 2)) if self.yielding is None else self.yielding
        for name, values, low, high in (
                ("parent", self.parent, 0, np.arange(n) - 1), ("radius", self.radius, 1e-5, 1.0),
                ("young_modulus", self.young_modulus, 1.0, 1e13), ("half_width", self.half_width, 0.0, np.inf),
                ("density", self.density, 0.0, np.inf), ("length", self.lengths(), 1e-5, 10.0),
                ("Poisson's ratio", np.full(n, self.poisson_ratio), 0.0, 0.4999),
                ("bending stiffness of the core", core[:, 0], 0.0, (1.0 + 1e-9) * self.young_modulus * second),
                ("yield moment of the core", core[:, 1], 0.0, 1e300)):
            most = np.broadcast_to(high, n)
            wrong = 1 + np.flatnonzero(~((values >= low) & (values <= most))[1:])  # entry 0 is not read
            if len(wrong):
                raise SceneError(f"plant: the {name} of segment {wrong[0]} is {values[wrong[0]]:g}; it must be from "
                                 f"{low:g} to {most[wrong[0]]:g}.")
        along = (self.nodes[1:] - self.nodes[self.parent[1:]]) / self.lengths()[1:, None]
        blade = self.half_width[1:] > 0.0
        tilt = np.abs(np.einsum("ij,ij->i", along, self.blade_normal[1:]))[blade]
        size = np.linalg.norm(self.blade_normal[1:], axis=1)[blade]
        if not ((tilt < 1e-6) & (np.abs(size - 1.0) < 1e-6)).all():
            raise SceneError("plant: the normal of a blade must be a unit vector across its segment.")

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
