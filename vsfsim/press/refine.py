"""The same press on finer and finer meshes: observed order of convergence, extrapolated force, and its error.

Order and error as Celik et al. 2008 (Procedure for estimation and reporting of uncertainty due to discretization, J.
Fluids Eng. 130, 078001; after Roache 1994), for the last three meshes, finest first, with h the edge near the contact,
or (volume / tetrahedra)^(1/3) for a scan, whose triangles are of all sizes:

    p = |ln |e32 / e21| + q(p)| / ln r21,    q(p) = ln((r21^p - s) / (r32^p - s)),    s = sign(e32 / e21),    e21 = F2 -
    F1 F = F1 + (F1 - F2) / (r21^p - 1),        error = 1.25 |F1 - F2| / (r21^p - 1)

A sequence that is not monotone, or whose steps grow, has no order: then there is no extrapolation, and the error is the
spread.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene
from vsfsim.core.shape import MeshFile
from vsfsim.physics import tiers
from vsfsim.press import probe as presses

# of the edges of two meshes: three meshes then span 1.69, the finest has 4.8 times the tetrahedra of the first
RATIO = 1.3
SAFETY = 1.25  # of the error, for three meshes or more (Roache)
STEEP = 4.0  # quadratic elements give no more in an integral of the stresses; a higher observed order is chance


@dataclass(frozen=True)
class Convergence:
    """What a sequence of meshes says about one force.

    edge: h of each mesh (k,) [m], coarsest first. force: of each (k,) [N]. order: observed [-], or None. extrapolated:
    [N], or None.
    error: of the extrapolated force, or of the finest mesh's where there is none [N]. statement: in words.
    """

    edge: np.ndarray
    force: np.ndarray
    order: float | None
    extrapolated: float | None
    error: float
    statement: str

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in vars(self).items()}


def convergence(edge: Sequence[float], force: Sequence[float], *, tolerance: float) -> Convergence:
    """Order, extrapolation and error of a force on three or more meshes.

    Args:
        edge: h of each mesh [m], coarsest first. force: [N]. tolerance: relative error of each force left by the solver
        [-].
    """
    h, f = np.asarray(edge, float), np.asarray(force, float)
    assert len(h) == len(f) >= 3 and (np.diff(h) < 0.0).all()
    e21, e32 = f[-2] - f[-1], f[-3] - f[-2]
    spread = float(np.ptp(f[-3:]))
    size = max(abs(float(f[-1])), 1e-300)
    noise = 2.0 * tolerance * size
    share = f"{100 * spread / size:.2g} %"
    if spread == 0.0 or spread <= noise:
        error = max(spread, tolerance * size)
        return Convergence(h, f, None, None, error,
                           f"The last three meshes agree to {share}, the solver's own tolerance: no order can be "
                           f"observed; the force is "
                           f"{f[-1]:.5g} N, error about {error:.1g} N ({100 * error / size:.2g} %).")
    r21, r32 = h[-2] / h[-1], h[-3] / h[-2]
    # the least ratio of two steps that an order above 0 can give; 1 for equal ratios of the edges
    if e21 * e32 <= 0.0 or e32 / e21 <= np.log(r32) / np.log(r21):
        why = "goes up and down" if e21 * e32 < 0.0 else "does not change less and less from mesh to mesh"
        return Convergence(h, f, None, None, spread,
                           f"No order of convergence is observed: the force {why}. It is {f[-1]:.5g} N on the finest "
                           f"mesh, and the spread of the "
                           f"last three, {spread:.2g} N ({share}), stands for its error. More meshes, or a finer "
                           f"start, may tell more.")
    order = _order(r21, r32, float(e32 / e21))
    used = min(order, STEEP)
    gain = r21**used - 1.0
    value = float(f[-1] - e21 / gain)
    error = SAFETY * abs(float(e21)) / gain
    text = (f"Observed order of convergence {order:.2f}; extrapolated force {value:.5g} N, error {error:.2g} N "
            f"({100 * error / max(abs(value), 1e-300):.2g} %); "
            f"the finest mesh is off by {100 * abs(f[-1] / value - 1.0):.2g} %.")
    if order > STEEP:
        text += f" More than {STEEP:g} is chance with quadratic elements: {STEEP:g} was used."
    if order < 0.5:
        text += " So low an order extrapolates far: take a finer start before trusting it."
    return Convergence(h, f, float(order), value, error, text)


def _order(r21: float, r32: float, ratio: float) -> float:
    """Solve p ln r21 = ln(ratio) + ln((r21^p - 1) / (r32^p - 1)) for p > 0; ratio > 1, the sequence is monotone.

    (r32^p - 1) r21^p / (r21^p - 1) grows with p from ln r32 / ln r21, which is under the ratio.
    """
    def steps(p: float) -> float:
        return (r32**p - 1.0) * r21**p / (r21**p - 1.0)

    low, high = 1e-6, 60.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if steps(middle) < ratio else (low, middle)
    return 0.5 * (low + high)


def refine(scene: Scene, meshes: int, *, tier: str | None, device: str, precision: str, seed: int, cache: Path | None,
           keep: bool,
           progress: Callable[[int, int, str], None] | None) -> tuple[list[presses.PressResult], Convergence]:
    """Run a press on ``meshes`` >= 3 meshes, each finer by RATIO; arguments as `press.press`.

    The first is the tier's own; a path that was assumed is assumed once, on it. Returns all results, coarsest first,
    and what they say about the force at full depth.
    """
    results: list[presses.PressResult] = []
    first, model, chosen, notes, built = presses.prepare(scene, tier=tier, seed=seed, cache=cache)
    size = tiers.element_size(first.object, chosen, first.probe)
    for k in range(meshes):
        def told(done: int, total: int, what: str, k: int = k) -> None:
            if progress is not None:
                progress(done, total, f"{what} of mesh {k + 1} of {meshes}")

        current = first
        if k > 0:
            finer = dataclasses.replace(first.object, resolution=size / RATIO**k)
            current = dataclasses.replace(first, object=finer)
            current, model, _, more, built = presses.prepare(current, tier=tier, seed=seed, cache=cache)
            notes = [*notes, *(n for n in more if n not in notes)]
        results.append(presses.run(current, model, chosen, notes if k == 0 else [], built, device=device,
                                   precision=precision,
                                   keep=keep and k == meshes - 1, progress=told))
    at = results[0].inward - 1
    edge = [size_of(r, scene) for r in results]
    force = [float(np.linalg.norm(r.force[at])) for r in results]
    if -np.diff(edge).max() < 0.02 * max(edge):
        raise SceneError(f"{scene.source}: two of the {meshes} meshes came out of the same size "
                         f"({', '.join(str(r.tets) for r in results)} tetrahedra), "
                                 "so there is no convergence to see; give a finer resolution in [object].")
    return results, convergence(edge, force, tolerance=results[0].tolerance)


def size_of(result: presses.PressResult, scene: Scene) -> float:
    """The edge h of a mesh [m] that its error scales with."""
    if isinstance(scene.object.shape, MeshFile):
        return (result.volume / result.tets) ** (1.0 / 3.0)
    return result.edge_at_contact


def text(results: list[presses.PressResult], found: Convergence) -> str:
    """The meshes as a table, and what they say."""
    rows = ["mesh  tetrahedra    nodes  edge mm    force N  change %  converged  balance  penetr. %  seconds"]
    at = results[0].inward - 1
    before, edges = None, [*found.edge]
    for k, r in enumerate(results):
        force = float(np.linalg.norm(r.force[at]))
        change = "" if before is None else f"{100 * (force / before - 1.0):+.2f}" if before else "-"
        rows.append(f"{k + 1:4d} {r.tets:11d} {r.nodes:8d} {1e3 * edges[k]:8.2f} {force:10.5g} {change:>9} "
                    f"{int(r.converged.sum()):6d}/{len(r.converged):<4d}"
                    f" {r.audit['force_balance'].max():8.1e} {100 * r.audit['penetration'].max() / r.edge:9.2g} "
                    f"{r.build_seconds + r.seconds.sum():8.1f}")
        before = force
    rows.append(found.statement)
    if not all(r.converged.all() for r in results):
        rows.append("Some frames did not converge: their forces are no equilibria, and the order means nothing "
                    "until they do.")
    return "\n".join(rows)
