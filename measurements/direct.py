"""A press by Newton's method with a Cholesky factor at every step: scikit-fem's elements, CHOLMOD by way of cvxopt.

Linear or quadratic tetrahedra of a given mesh under `references/skfem_press.py`, with the laws of the references.
Nothing of vsfsim has a part in it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import cvxopt
import numpy as np
import skfem
from cvxopt import cholmod
from scipy.sparse import csc_matrix
from scipy.spatial import cKDTree

from references.skfem_press import STIFF, Foam, NeoHooke, Press, gap_of

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
"""Corners between which nodes 4 to 9 of a tetrahedron lie."""
LIMIT = 3600.0
"""Processor time after which no depth begins [s]."""


class Direct(Press):
    """A `Press` whose steps are solved by a factor of their own, with one symbolic factor for all."""

    stride = 1.0

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        column = np.repeat(np.arange(len(self.free)), np.diff(self.starts))
        self._matrix = cvxopt.spmatrix(1.0, cvxopt.matrix(self.rows), cvxopt.matrix(column), (len(self.free),) * 2)
        self._symbol = cholmod.symbolic(self._matrix)

    def direction(self, tangent: csc_matrix, right: np.ndarray) -> np.ndarray:
        """By a new factor; zero where the tangent is not positive definite."""
        self._matrix.V, step = cvxopt.matrix(tangent.data), cvxopt.matrix(right)
        try:
            cholmod.numeric(self._matrix, self._symbol)
        except ArithmeticError:
            return np.zeros_like(right)
        cholmod.solve(self._symbol, step)
        return np.array(step)[:, 0]


def press_of(given: Mapping[str, Any]) -> Direct:
    """The press of a body under a ball.

    Args:
        given: points (n, 3) [m] and tets (m, 4 or 10) of the mesh, by whose width its elements are linear or quadratic;
            held (n,) bool; young (m,) [Pa] and ratio [-], or the rows foam of `Foam`; radius of the ball [m]; edge of
            the elements [m]; tolerance, see `Press`.
    """
    points, tets, quadratic = given["points"], given["tets"], given["tets"].shape[1] == 10
    corners = points[:tets[:, :4].max() + 1]
    mesh: Any = skfem.MeshTet(corners.T.copy(), np.ascontiguousarray(tets[:, :4].T, np.int64))
    if quadratic:  # with our nodes between the corners, which lie on a curved surface
        straight = np.concatenate([corners, np.zeros((len(points) - len(corners), 3))])
        for node, (a, b) in enumerate(EDGES, start=4):
            straight[tets[:, node]] = 0.5 * (points[tets[:, a]] + points[tets[:, b]])
        mesh = skfem.MeshTet2.from_mesh(mesh)
        mesh = skfem.MeshTet2(points[cKDTree(straight).query(mesh.doflocs.T)[1]].T.copy(), mesh.t)
    element = skfem.ElementVector(skfem.ElementTetP2() if quadratic else skfem.ElementTetP1())
    basis, high = skfem.Basis(mesh, element, intorder=2 if quadratic else 1), points[:, 2].max()
    upper = mesh.facets_satisfying(lambda x: x[2] > 0.6 * high, boundaries_only=True)
    young = given["young"][:, None]
    law = Foam(given["foam"]) if len(given["foam"]) else NeoHooke(young, given["ratio"])
    held = np.flatnonzero(cKDTree(points[given["held"]]).query(basis.doflocs.T)[0] < 1e-9)
    return Direct(basis, skfem.FacetBasis(mesh, element, facets=upper, intorder=6), law, held,
                  gap_of(("sphere", given["radius"])), penalty=STIFF * float(young.min()) / given["edge"],
                  tolerance=given["tolerance"])


def run(given: Mapping[str, Any], origins: np.ndarray) -> dict[str, Any]:
    """The forces [N] with the ball's lowest point at each of ``origins`` (t, 3) [m], until there is no equilibrium or
    `LIMIT` is over; what is unbalanced of each [-]; the processor time of bases, pattern and symbolic factor, and of
    each [s]."""
    began = time.process_time()
    press = press_of(given)
    found: dict[str, list[float]] = {"forces": [], "balance": [], "seconds": []}
    once, here = time.process_time() - began, origins[0] + [0.0, 0.0, 1e-9]
    for origin in origins:
        began = time.process_time()
        try:
            force = press.curve(np.array([here, origin]))[0]
        except RuntimeError:
            break
        here, (own, push) = origin, press.forces(press.u, origin)
        left = float(np.abs((own + push)[press.free]).sum() / np.abs(push).sum())
        for name, value in (("forces", force), ("balance", left), ("seconds", time.process_time() - began)):
            found[name].append(value)
        if sum(found["seconds"]) > LIMIT:
            break
    return {**found, "once": once, "unknowns": len(press.free)}
