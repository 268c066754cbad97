"""The same press of a bubble on rigid bodies with finer and finer triangles where they touch: force, pressure, dent and
bulge on each mesh.

Edges at the contact are halved from mesh to mesh, and the mesh before the last is the one that `vsfsim press` takes by
itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene
from vsfsim.core.shape import Capsule, Sphere
from vsfsim.physics.mesh.membrane_refine import SHARE
from vsfsim.press import bubble as press_bubble
from vsfsim.press.refine import Convergence, convergence


@dataclass(frozen=True)
class Dent:
    """Shape of the dented skin in one frame.

    depth: farthest way of a node along the press [m]. radius: of the circle with the area, across the press, of the
    skin that went half as far or more [m].
    bulge: farthest way of a node outwards, along the free dome's normal [m].
    """

    depth: float
    radius: float
    bulge: float


def dent(result: press_bubble.BubblePress, frame: int, axis: np.ndarray) -> Dent:
    """The dent of a frame; ``axis``: the way of the bodies into the dome, in the mount frame (3,). The result must have
    kept its state."""
    state = result.state
    assert state is not None
    mesh = state.model.mesh
    moved = state.node_position[frame] - mesh.points
    corners = mesh.points[mesh.faces]
    vector = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros_like(mesh.points)
    for k in range(3):
        np.add.at(normal, mesh.faces[:, k], vector)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    sunk = moved @ axis
    most = float(sunk.max())
    over = _share_over(sunk[mesh.faces] - 0.5 * most)
    area = float((np.abs(vector @ axis) * over).sum())
    return Dent(most, float(np.sqrt(area / np.pi)), float((moved * normal).sum(axis=1).max()))


def _share_over(values: np.ndarray) -> np.ndarray:
    """Share of a triangle's area where a linear function, given at its corners (f, 3), is positive (f,)."""
    low, middle, high = np.sort(values, axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        one = high**2 / ((high - low) * (high - middle))  # only the highest corner is over
        two = 1.0 - low**2 / ((middle - low) * (high - low))  # only the lowest is not
    return np.where(low >= 0.0, 1.0, np.where(high <= 0.0, 0.0, np.where(middle > 0.0, two, one)))


def refine(scene: Scene, meshes: int, *, device: str, precision: str, cache: Path | None,
           progress: Callable[[int, int, str], None] | None) -> tuple[list[press_bubble.BubblePress], Convergence,
                                                                      Convergence]:
    """The press on ``meshes`` >= 3 meshes, coarsest first, and what they say about force and pressure at full depth;
    arguments as `press_bubble.press`.

    Raises:
        SceneError: an object is pressed, or bodies without a radius and no contact_edge is given.
    """
    assert scene.sensor is not None
    if scene.object is not None:
        raise SceneError(f"{scene.source}: --refine refines a [sensor] where rigid bodies touch it; with an [object] "
                         f"set nodes in [sensor] and resolution in [object], and compare.")
    edge = scene.sensor.contact_edge
    if edge is None:
        radii = [body.radius for body in scene.bodies if isinstance(body, (Sphere, Capsule))]
        if not radii:
            raise SceneError(f"{scene.source}: --refine halves the edges where bodies touch, which follow the radius "
                             f"of balls and capsules; for other bodies give contact_edge in [sensor].")
        edge = SHARE * min(radii)
    results = []
    for k in range(meshes):
        def told(done: int, total: int, what: str, k: int = k) -> None:
            if progress is not None:
                progress(done, total, f"{what} of mesh {k + 1} of {meshes}")

        sensor = dataclasses.replace(scene.sensor, contact_edge=edge * 2.0 ** (meshes - 2 - k))
        results.append(press_bubble.press(dataclasses.replace(scene, sensor=sensor), device=device, precision=precision,
                                          cache=cache, keep=True, progress=told))
    sizes = [r.edge for r in results]
    if -np.diff(sizes).max() < 0.02 * max(sizes):
        raise SceneError(f"{scene.source}: two of the {meshes} meshes came out of the same size "
                         f"({', '.join(str(r.nodes) for r in results)} nodes), so there is no convergence to see; "
                         "give fewer meshes, or a smaller contact_edge in [sensor].")
    at = results[0].inward - 1
    found = [convergence(sizes, values, tolerance=results[0].tolerance) for values in
             ([float(np.linalg.norm(r.force[at])) for r in results], [float(r.pressure_change[at]) for r in results])]
    return results, found[0], found[1]


def rows_of(results: list[press_bubble.BubblePress], axis: np.ndarray) -> list[dict[str, Any]]:
    """Numbers of every mesh at half and at full depth; ``axis`` as `dent`."""
    out = []
    for r in results:
        full = r.inward - 1
        half = int(np.abs(r.depth[:full + 1] - 0.5 * r.depth[full]).argmin())
        for t in (half, full):
            shape = dent(r, t, axis)
            out.append({"nodes": r.nodes, "edge": r.edge, "depth": float(r.depth[t]),
                        "force": float(np.linalg.norm(r.force[t])), "pressure_change": float(r.pressure_change[t]),
                        "dent_depth": shape.depth, "dent_radius": shape.radius, "bulge": shape.bulge,
                        "converged": bool(r.converged[t]), "seconds": float(r.seconds.mean()),
                        "newton": float(r.iterations.mean())})
    return out


def text(rows: list[dict[str, Any]], force: Convergence, pressure: Convergence) -> str:
    """The meshes as a table, and what they say."""
    lines = ["  nodes  edge mm  depth mm   force N  change Pa  dent radius mm  bulge mm  s a frame  Newton a frame"]
    lines += [f"{r['nodes']:7d} {1e3 * r['edge']:8.2f} {1e3 * r['depth']:9.2f} {r['force']:9.4f} "
              f"{r['pressure_change']:10.1f} {1e3 * r['dent_radius']:15.2f} {1e3 * r['bulge']:9.3f}"
              f" {r['seconds']:10.2f} {r['newton']:15.1f}{'' if r['converged'] else '  NOT CONVERGED'}" for r in rows]
    lines += [_said("Force", "N", force), _said("Pressure change", "Pa", pressure)]
    return "\n".join(lines)


def _said(name: str, unit: str, found: Convergence) -> str:
    if found.order is None or found.extrapolated is None:
        return (f"{name} at full depth: no order of convergence is observed; {found.error:.2g} {unit}, the spread of "
                f"the last three meshes, stands for its error.")
    off = ", ".join(f"{100 * (v / found.extrapolated - 1.0):+.2g}" for v in found.force)
    return (f"{name} at full depth: observed order {found.order:.2f}, extrapolated {found.extrapolated:.5g} {unit} "
            f"with an error of {found.error:.2g} {unit}; "
            f"the meshes are off by {off} %.")
