"""Hexahedra and prisms cut into tetrahedra that fit their neighbours.

Every quadrilateral face is cut by the diagonal at its lowest-ranked corner, so two cells that share a face
agree without knowing of each other (Dompierre et al. 1999, "How to subdivide pyramids, prisms and
hexahedra into tetrahedra"). The ranking is the caller's: it decides where the diagonals lie.
"""

from __future__ import annotations

import numpy as np

# Corners of a hexahedron: 0-3 around the bottom, counter-clockwise seen from above, 4-7 above them.
# The three faces that do not touch corner v, each in order around the face and starting at its corner
# farthest from v in the face's own sense (any order around the face will do).
_OPPOSITE = {
    0: ((6, 7, 4, 5), (6, 5, 1, 2), (6, 2, 3, 7)),
    1: ((7, 4, 5, 6), (7, 6, 2, 3), (7, 3, 0, 4)),
    2: ((4, 5, 6, 7), (4, 7, 3, 0), (4, 0, 1, 5)),
    3: ((5, 6, 7, 4), (5, 4, 0, 1), (5, 1, 2, 6)),
    4: ((2, 1, 0, 3), (2, 3, 7, 6), (2, 6, 5, 1)),
    5: ((3, 2, 1, 0), (3, 0, 4, 7), (3, 7, 6, 2)),
    6: ((0, 3, 2, 1), (0, 1, 5, 4), (0, 4, 7, 3)),
    7: ((1, 0, 3, 2), (1, 2, 6, 5), (1, 5, 4, 0)),
}


def split_hexes(hexes: np.ndarray, rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut hexahedra into five or six tetrahedra each, fitting across every shared face.

    Args:
        hexes: corner indices (c, 8), 0-3 around the bottom (counter-clockwise from above), 4-7 above them.
        rank: one distinct number per vertex (n,); each face is cut at its lowest-ranked corner.

    Returns:
        Corner indices of the tetrahedra (m, 4), positively oriented for a right-handed cell, and the
        hexahedron each came from (m,).
    """
    cells: list[np.ndarray] = []
    owners: list[np.ndarray] = []
    order = rank[hexes]
    apex = order.argmin(axis=1)
    for v, faces in _OPPOSITE.items():
        mine = np.flatnonzero(apex == v)
        if not len(mine):
            continue
        h = hexes[mine]
        # A face (far, a, b, c) is cut far-b or a-c; "far" is the corner opposite the apex in the hexahedron.
        through_far = []
        for far, a, b, c in faces:
            r = rank[h[:, [far, a, b, c]]].argmin(axis=1)
            through_far.append((r == 0) | (r == 2))
        # No diagonal at the far corner: cut that corner off, and a regular tetrahedron remains (five in all).
        five = ~(through_far[0] | through_far[1] | through_far[2])
        far = faces[0][0]
        neighbours = [faces[0][1], faces[1][1], faces[2][1]]
        for (_, a, b, c), cut in zip(faces, through_far):
            _emit(cells, owners, h, mine, cut, (v, far, a, b))
            _emit(cells, owners, h, mine, cut, (v, far, b, c))
            _emit(cells, owners, h, mine, ~cut, (v, a, b, c))
            _emit(cells, owners, h, mine, ~cut & ~five, (v, far, a, c))
        _emit(cells, owners, h, mine, five, (v, *neighbours))
        _emit(cells, owners, h, mine, five, (far, *neighbours[::-1]))
    return _in_order(cells, owners)


def split_prisms(prisms: np.ndarray, rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangular prisms into three tetrahedra each; see `split_hexes`.

    Args:
        prisms: corner indices (c, 6), 0-2 around the bottom (counter-clockwise from above), 3-5 above them.
        rank: one distinct number per vertex (n,).
    """
    cells: list[np.ndarray] = []
    owners: list[np.ndarray] = []
    apex = rank[prisms].argmin(axis=1)
    turns = {0: (0, 1, 2, 3, 4, 5), 1: (1, 2, 0, 4, 5, 3), 2: (2, 0, 1, 5, 3, 4),
             3: (3, 5, 4, 0, 2, 1), 4: (4, 3, 5, 1, 0, 2), 5: (5, 4, 3, 2, 1, 0)}
    for v, turn in turns.items():
        mine = np.flatnonzero(apex == v)
        p = prisms[mine][:, turn]
        # The apex is corner 0 now; only the face 1-2-5-4 is left to choose.
        low = rank[p[:, [1, 2, 5, 4]]].argmin(axis=1) if len(mine) else np.zeros(0, int)
        cut = (low == 0) | (low == 2)
        every = np.ones(len(mine), bool)
        _emit(cells, owners, p, mine, every, (0, 4, 5, 3))
        _emit(cells, owners, p, mine, cut, (0, 1, 2, 5))
        _emit(cells, owners, p, mine, cut, (0, 1, 5, 4))
        _emit(cells, owners, p, mine, ~cut, (0, 1, 2, 4))
        _emit(cells, owners, p, mine, ~cut, (0, 2, 5, 4))
    return _in_order(cells, owners)


def _emit(cells: list[np.ndarray], owners: list[np.ndarray], corners: np.ndarray, owner: np.ndarray,
          keep: np.ndarray, pick: tuple[int, ...]) -> None:
    cells.append(corners[keep][:, pick])
    owners.append(owner[keep])


def _in_order(cells: list[np.ndarray], owners: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    tets, owner = np.concatenate(cells), np.concatenate(owners)
    by_owner = np.argsort(owner, kind="stable")
    return tets[by_owner], owner[by_owner]
