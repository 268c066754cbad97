"""How well an error is estimated: `vsfsim measure effectivity`.

S1 and S2 are pressed on elements of several sizes. The error of the force, against the curves of references/, stands
beside two estimates of it, and their effectivity: estimate over error, 1 if it is right.

1. `vsfsim.physics.mesh.resolved.mesh_error`, from the radius of the contact over the edge of an element; every frame of
   a dataset holds it.
2. The dual-weighted residual with the contact force as goal (Becker and Rannacher 2001, An optimal control approach to
   a posteriori error estimation in finite element methods, Acta Numerica 10, 1-102). Its dual problem asks how the
   force answers to a load anywhere. By the symmetry of the tangent that is the displacement by one more unit of the
   ball's way, which the difference of two frames gives without a back-solve. The residual is weighted in its energy
   form: the gradients of the displacement and of the dual solution, each less its mean over the elements at a corner
   (Zienkiewicz and Zhu 1987), with the elasticity of small strain,

       F_h - F = sum over elements of (grad u_h - G u) : A : (grad z_h - G z) volume.

The solver takes most of the first error away itself, by its local indentation; errors are given with it and without.
"""

from __future__ import annotations

import dataclasses

import numpy as np

import references
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.trust.indentation import BLOCKS
from vsfsim.core.scene import load_scene
from vsfsim.core.shape import Sphere
from vsfsim.core.shelf import find_scene
from vsfsim.physics import tiers
from vsfsim.physics.elements.tet10_shape import GAUSS_FAR, GAUSS_NEAR, shape_gradients
from vsfsim.physics.model import Model
from vsfsim.physics.solve.touches import Solver

EDGES = (0.020, 0.0155, 0.0125, 0.010)
"""Of the elements [m]."""
DEPTHS = np.array([0.001, 0.0025, 0.005])
"""Of the ball [m]."""
STEP = 0.9
"""Share of a depth at which the frame before it stands, from which the dual solution is taken [-]."""
TOLD = 2.0
"""Errors of a reference by which an error must exceed it for an effectivity to be told [-]."""
AIM = (0.5, 2.0)
"""Effectivities that are called right [-]."""


def dual_weighted(model: Model, u: np.ndarray, z: np.ndarray, ratio: float) -> float:
    """The dual-weighted residual of a goal [unit of the goal].

    Args:
        model: of tetrahedra.
        u: displacement (n, 3) [m].
        z: dual solution (n, 3), the displacement by one unit of the goal's own motion [-].
        ratio: Poisson's ratio [-].
    """
    primal, dual = (_rough(model, field) for field in (u, z))
    mu = 0.5 * model.young_modulus / (1.0 + ratio)
    lam = 2.0 * mu * ratio / (1.0 - 2.0 * ratio)
    shear = np.einsum("mqij,mqij->mq", 0.5 * (primal + primal.swapaxes(2, 3)), 0.5 * (dual + dual.swapaxes(2, 3)))
    # an element keeps its volume as a whole
    trace = [np.trace(g, axis1=2, axis2=3).mean(axis=1) for g in (primal, dual)]
    density = 2.0 * mu * shear + lam * (trace[0] * trace[1])[:, None]
    return float((density.mean(axis=1) * model.mesh.volume).sum())


def _rough(model: Model, field: np.ndarray) -> np.ndarray:
    """The gradient of a field at the Gauss points less its smoothed self (m, 4, 3, 3)."""
    mesh = model.mesh
    moved = field[mesh.tets]
    at = np.stack([np.einsum("mac,mai->mic", shape_gradients(mesh.gradients, q), moved) for q in range(4)], axis=1)
    bary = np.full((4, 4), GAUSS_FAR)
    np.fill_diagonal(bary, GAUSS_NEAR)
    corners = np.einsum("kq,mqij->mkij", np.linalg.inv(bary), at)  # linear in an element
    # the mean over the elements at a corner, of one material each: across a boundary a gradient jumps
    stuff = np.unique(np.round(np.log10(model.young_modulus.mean(axis=1)), 1), return_inverse=True)[1]
    place = mesh.tets[:, :4] + stuff[:, None] * len(mesh.points)
    weight, total = np.zeros(place.max() + 1), np.zeros((place.max() + 1, 3, 3))
    np.add.at(weight, place, mesh.volume[:, None])
    np.add.at(total, place, corners * mesh.volume[:, None, None, None])
    smooth = (total[place] / weight[place][..., None, None])
    return at - np.einsum("qk,mkij->mqij", bary, smooth)


def rows_of(case: str, edge: float) -> list[dict[str, object]]:
    """One a depth: error and estimates."""
    scene, curve = load_scene(find_scene(BLOCKS[case])).sample(0), references.load(case.lower())
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.required_object, resolution=edge))
    model = tiers.build(scene, "fem")
    depths = np.sort(np.concatenate([STEP * DEPTHS, DEPTHS]))
    assert isinstance(scene.probe, Sphere)
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    if case == "S1":
        poses[:, 0, :2, 3] = 0.29 * edge  # at no node; the part inside S2 is not under the middle
    poses[:, 0, 2, 3] = model.mesh.points[:, 2].max() + scene.probe.radius - depths
    own, out = tiers.options("fem"), []
    solver = Solver(model, scene.probe, options=dataclasses.replace(own, local_indentation=False))
    plain = solver.run(poses, keep=True)
    frames = Solver(model, scene.probe, options=own).run(poses)
    for t, depth in enumerate(depths):
        if depth not in DEPTHS or depth < min(curve["depth_m"]):
            continue
        exact = float(np.interp(depth, curve["depth_m"], curve["force_N"]))
        u, before = (solver.history[k][:, 0].reshape(-1, 3) for k in (t, t - 1))
        z = (u - before) / (depth - depths[t - 1])
        error, bare = (float(f.force[t, 0, 2]) / exact - 1.0 for f in (frames, plain))
        weighted = dual_weighted(model, u, z, scene.required_object.poisson_ratio) / exact
        estimate, told = float(frames.mesh_error[t, 0]), TOLD * curve["relative_error"]
        out.append({"case": case, "edge": edge, "depth": float(depth), "known": curve["relative_error"],
                    "error": error, "estimate": estimate, "plain": bare, "weighted": weighted,
                    "effectivity": estimate / abs(error) if abs(error) > told else None,
                    "weighted_effectivity": weighted / bare if abs(bare) > told else None})
    return out


def measure(*, edges: tuple[float, ...] = EDGES, progress: Progress = lambda said: None) -> Measurement:
    """The table of S1 and S2."""
    rows: list[dict[str, object]] = []
    for case in BLOCKS:
        for edge in edges:
            progress(f"{case}, elements of {1e3 * edge:g} mm ...")
            rows += rows_of(case, edge)
    notes = []
    for case in BLOCKS:
        for key, name in (("effectivity", "contact estimate"), ("weighted_effectivity", "dual-weighted residual")):
            own = np.array([row[key] for row in rows if row["case"] == case and row[key] is not None], float)
            right = int(((own >= AIM[0]) & (own <= AIM[1])).sum())
            notes.append(f"{case}, {name}: median effectivity {np.median(own):.2f}, {right} of {len(own)} from "
                         f"{AIM[0]:g} to {AIM[1]:g}")
    columns = [Column("case", "case"), Column("edge", "element", "m", "mm", ".1f"),
               Column("depth", "depth", "m", "mm", ".1f"), Column("known", "reference known to", "1", "%", ".1f"),
               Column("error", "error", "1", "%", "+.1f"), Column("estimate", "contact estimate", "1", "%", ".1f"),
               Column("effectivity", "effectivity", "1", "", ".2f"),
               Column("plain", "error without local indentation", "1", "%", "+.1f"),
               Column("weighted", "dual-weighted residual", "1", "%", "+.1f"),
               Column("weighted_effectivity", "effectivity", "1", "", ".2f")]
    return Measurement.of("effectivity", {"edges": list(edges)}, [
        Table("Error of the force at tier fem, and its estimates", columns, rows, name="effectivity")], notes=notes)
