"""The tier `spring`: a network of springs on the nodes of the quadratic mesh.

Every quadratic tetrahedron is cut into eight (corners, and the octahedron about its shortest diagonal); the edges of
these are the springs. With constants by volume alone (Van Gelder 1998, k = sum E V / L^2) the network is as anisotropic
as the mesh: a block of an even mesh is 14 % too stiff along it, and 20 % too soft in shear. The constants are therefore
fitted: around every node, the stiffness along sixteen directions shall be that of an isotropic network, by
multiplicative updates that keep every constant positive (Daube-Witherspoon and Muehllehner 1986, "ISRA").

An isotropic network has nu = 1/4 where its nodes follow a uniform strain. They do not exactly, as the network relaxes;
this also lowers E, which `RELAXATION` corrects. Observed on blocks pulled along each axis: with 720 to 2,500 tetrahedra
E within 2.5 % and nu 0.18 to 0.23, its mean 0.20; with 160 to 360 tetrahedra E within 5 % and nu 0.10 to 0.31. The
shear modulus along the axes of the mesh is 10 to 15 % low.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from vsfsim.physics.coefficients import SPRING_ALONG
from vsfsim.physics.elements import cell, spring
from vsfsim.physics.elements.block import Block
from vsfsim.physics.mesh.quadratic import QuadraticMesh

_CORNERS = np.array([[0, 4, 6, 7], [1, 4, 5, 8], [2, 5, 6, 9], [3, 7, 8, 9]])
_DIAGONALS = ((4, 9), (5, 7), (6, 8))  # of the octahedron that is left
_RINGS = ((5, 6, 7, 8), (4, 6, 9, 8), (4, 5, 9, 7))  # the four nodes around each
_PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
# Blocks of 160 to 1,280 tetrahedra are this much softer than a uniform strain says, 1.03 to 1.055 along the three axes.
RELAXATION = 1.045
OBSERVED_POISSON_RATIO, POISSON_SPREAD = 0.20, 0.03  # of blocks of 720 tetrahedra and more, see above
CELL = 1.0  # modulus of the pressure that keeps a cell's volume over Young's modulus [-], see `elements.cell`
_ROUNDS, _HASTE = 60, 1.8  # updates, and the power of each (1 is ISRA as published, and needs twice as many)


def _directions() -> np.ndarray:
    """The axes of an icosahedron and of a dodecahedron (16, 3): more than the 15 that fix a fourth-order symmetric
    tensor."""
    g = 0.5 * (1.0 + np.sqrt(5.0))
    d = np.array([[0, 1, g], [0, 1, -g], [1, g, 0], [1, -g, 0], [g, 0, 1], [-g, 0, 1], [1, 1, 1], [1, 1, -1],
                  [1, -1, 1], [-1, 1, 1],
                  [0, 1 / g, g], [0, 1 / g, -g], [1 / g, g, 0], [1 / g, -g, 0], [g, 0, 1 / g], [-g, 0, 1 / g]])
    return d / np.linalg.norm(d, axis=1)[:, None]


def cut_in_eight(mesh: QuadraticMesh) -> tuple[np.ndarray, np.ndarray]:
    """Linear tetrahedra on the nodes of the quadratic ones (8 m, 4), and the tetrahedron each came from (8 m,)."""
    tets, points = mesh.tets, mesh.points
    cells, owners = [tets[:, c] for c in _CORNERS], [np.arange(len(tets))] * 4
    length = np.stack([np.linalg.norm(points[tets[:, a]] - points[tets[:, b]], axis=1) for a, b in _DIAGONALS], axis=1)
    # of equal ones the first: rounding must not choose
    shortest = (length < length.min(axis=1, keepdims=True) * (1.0 + 1e-9)).argmax(axis=1)
    for number, ((a, b), ring) in enumerate(zip(_DIAGONALS, _RINGS, strict=True)):
        mine = np.flatnonzero(shortest == number)
        for i in range(4):
            cells.append(tets[mine][:, [a, b, ring[i], ring[(i + 1) % 4]]])
            owners.append(mine)
    return np.vstack(cells), np.concatenate(owners)


def spring_network(mesh: QuadraticMesh, young_modulus: np.ndarray, poisson_ratio: float) -> tuple[Block, ...]:
    """Springs with the observed small-strain modulus E; their Poisson's ratio is `OBSERVED_POISSON_RATIO`. Springs
    resist no change of volume, so cells do that have lost a tenth of theirs.

    Args:
        mesh: the placed mesh.
        young_modulus: at the Gauss points (m, 4) [Pa].
        poisson_ratio: ignored; every element's block takes one.
    """
    cells, owner = cut_in_eight(mesh)
    volume = mesh.volume[owner] / 8.0  # the parts are of equal size
    edges, edge_of = np.unique(np.sort(cells[:, _PAIRS].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(-1, 6)
    edge = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    square = (edge**2).sum(axis=1)
    # the mean modulus of a tetrahedron: a spring knows no finer one
    strength = np.bincount(edge_of.ravel(), np.repeat(young_modulus.mean(axis=1)[owner] * volume, 6), len(edges))
    factor = _isotropic(len(mesh.points), cells, volume, edge_of, edge / np.sqrt(square)[:, None])
    return (spring.block(edges, mesh.points, RELAXATION * factor * strength / square),
            cell.block(cells, mesh.points, CELL * young_modulus.mean(axis=1)[owner]))


def _isotropic(points: int, cells: np.ndarray, volume: np.ndarray, edge_of: np.ndarray,
               direction: np.ndarray) -> np.ndarray:
    """Factors (e,) on k L^2 = V that make the network isotropic in every neighbourhood, for E = 1.

    Args:
        points: number of nodes. cells: (c, 4), their volume (c,) [m^3], their edges (c, 6). direction: of every edge
        (e, 3).
    """
    start = np.bincount(edge_of.ravel(), np.repeat(volume, 6), len(direction))
    along = (direction @ _directions().T) ** 4  # (n.d)^4, (e, 16)
    # a spring belongs to the nodes of its cells, in proportion to the cells' volume
    share = np.tile(volume[:, None] / start[edge_of], (1, 4)).ravel()
    star = sp.coo_matrix((share, (np.repeat(cells, 6, axis=1).ravel(), np.tile(edge_of, (1, 4)).ravel())),
                         shape=(points, len(direction))).tocsr()
    aim = SPRING_ALONG * np.bincount(cells.ravel(), np.repeat(volume, 4), points)
    # and of their neighbours: within one star of a surface node there are not enough directions, and the faces would
    # come out too stiff
    ring = (star @ star.T > 0.0).astype(float)
    around = sp.diags(1.0 / (ring @ aim)) @ ring
    back, outward = star.T.tocsr(), around.T.tocsr()
    wanted = (back @ (outward @ np.ones(points))) * along.sum(axis=1)
    strength = start
    for _ in range(_ROUNDS):
        strength = strength * (wanted / ((back @ (outward @ (around @ (star @ (strength[:, None] * along)))))
                                         * along).sum(axis=1)) ** _HASTE
    return strength / start
