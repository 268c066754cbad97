"""The press in scikit-fem: quadratic tetrahedra under `references/skfem_press.py`, with the laws of the references.

Runs in a venv of its own with scikit-fem; nothing of vsfsim is imported.
"""

import numpy as np
import skfem

from references.skfem_press import STIFF, TOLERANCE, Foam, NeoHooke, Press, gap_of


def make(given):
    """See `measurements.indent.pressing`."""
    mesh = skfem.MeshTet(given["points"].T.copy(), given["tets"].T.astype(np.int64).copy())
    element, high = skfem.ElementVector(skfem.ElementTetP2()), mesh.p[2].max()
    basis = skfem.Basis(mesh, element, intorder=3)
    top = mesh.facets_satisfying(lambda x: np.abs(x[2] - high) < 1e-9, boundaries_only=True)
    young = given["young"][:, None]  # scikit-fem keeps the order of the elements
    law = Foam(given["foam"]) if "foam" in given else NeoHooke(young, float(given["ratio"]))
    held = np.flatnonzero(np.abs(basis.doflocs[2]) < 1e-9)
    press = Press(basis, skfem.FacetBasis(mesh, element, facets=top, intorder=6), law, held,
                  gap_of(("sphere", float(given["radius"]))), penalty=STIFF * float(young.min()) / float(given["edge"]))
    here = np.array([*given["at"], high])

    def to(depth):
        nonlocal here
        before, here = here, np.array([*given["at"], high - depth])
        (force,) = press.curve(np.array([before, here]))
        own, push = press.forces(press.u, here)
        return force, float(np.abs((own + push)[press.free]).sum() / np.abs(push).sum())

    settings = (f"quadratic tetrahedra, the law of the reference, Newton's method with a direct solver until "
                f"{TOLERANCE:g} of the force is unbalanced, penalty of {STIFF:g} times the modulus over an edge")
    return skfem.__version__, settings, to
