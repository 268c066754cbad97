"""Hexahedra and prisms cut into tetrahedra that fit their neighbours.

Every quadrilateral face is cut by the diagonal at its lowest-ranked corner, so two cells that share a face
agree without knowing of each other (Dompierre et al. 1999, "How to subdivide pyramids, prisms and
hexahedra into tetrahedra"). The ranking is the caller's: it decides where the diagonals lie.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Rotations of a cell that bring corner v (row v) to the place of corner 0. Corners of a hexahedron: 0-3 around the
# bottom, counter-clockwise seen from above, 4-7 above them; those of a prism are 0-2 and 3-5.
_HEX_TURNS = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [1, 2, 3, 0, 5, 6, 7, 4], [2, 3, 0, 1, 6, 7, 4, 5],
                       [3, 0, 1, 2, 7, 4, 5, 6], [4, 7, 6, 5, 0, 3, 2, 1], [5, 4, 7, 6, 1, 0, 3, 2],
                       [6, 5, 4, 7, 2, 1, 0, 3], [7, 6, 5, 4, 3, 2, 1, 0]])
_PRISM_TURNS = np.array([[0, 1, 2, 3, 4, 5], [1, 2, 0, 4, 5, 3], [2, 0, 1, 5, 3, 4], [3, 5, 4, 0, 2, 1],
                         [4, 3, 5, 1, 0, 2], [5, 4, 3, 2, 1, 0]])


def split_hexes(hexes: np.ndarray, rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut hexahedra into five or six tetrahedra each, fitting across every shared face.

    Args:
        hexes: corner indices (c, 8), 0-3 around the bottom (counter-clockwise from above), 4-7 above them.
        rank: one distinct number per vertex (n,); each face is cut at its lowest-ranked corner.

    Returns:
        Corner indices of the tetrahedra (m, 4), positively oriented for a right-handed cell, and the
        hexahedron each came from (m,).
    """
    cells = np.take_along_axis(hexes, _HEX_TURNS[rank[hexes].argmin(axis=1)], axis=1)
    # The faces that do not touch the lowest corner, each from the corner opposite to it, 6; cuts through that corner.
    faces = ((6, 7, 4, 5), (6, 5, 1, 2), (6, 2, 3, 7))
    cuts = [rank[cells[:, face]].argmin(axis=1) % 2 == 0 for face in faces]
    # No diagonal at the far corner: cut that corner off, and a regular tetrahedron remains (five in all).
    five = ~np.logical_or.reduce(cuts)
    rows = []
    for (far, a, b, c), cut in zip(faces, cuts):
        rows += [(cut, (0, far, a, b)), (cut, (0, far, b, c)), (~cut, (0, a, b, c)), (~cut & ~five, (0, far, a, c))]
    return _chosen(cells, [*rows, (five, (0, 7, 5, 2)), (five, (6, 2, 5, 7))])


def split_prisms(prisms: np.ndarray, rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangular prisms into three tetrahedra each; see `split_hexes`.

    Args:
        prisms: corner indices (c, 6), 0-2 around the bottom (counter-clockwise from above), 3-5 above them.
        rank: one distinct number per vertex (n,).
    """
    cells = np.take_along_axis(prisms, _PRISM_TURNS[rank[prisms].argmin(axis=1)], axis=1)
    # Only the face 1-2-5-4 does not touch the lowest corner; is its diagonal at corner 1?
    cut = rank[cells[:, (1, 2, 5, 4)]].argmin(axis=1) % 2 == 0
    return _chosen(cells, [(np.ones(len(cells), bool), (0, 4, 5, 3)), (cut, (0, 1, 2, 5)), (cut, (0, 1, 5, 4)),
                           (~cut, (0, 1, 2, 4)), (~cut, (0, 2, 5, 4))])


def _chosen(cells: np.ndarray, rows: Sequence[tuple[np.ndarray, tuple[int, ...]]]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of some of the cells (c,), row by row, and the cell of each, in the order of the cells."""
    owner = np.concatenate([np.flatnonzero(mine) for mine, _ in rows])
    tets = np.concatenate([cells[mine][:, pick] for mine, pick in rows])
    order = np.argsort(owner, kind="stable")
    return tets[order], owner[order]
