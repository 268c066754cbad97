"""Flat square punch on S1's block at small strain: an independent computation of its force (`flat_punch.json`).

    python -m references.flat_punch      # four sides, two meshes each, extrapolated; a minute of a core

A quarter of the block, 27-node hexahedra (`soft_block.py`) that end at the punch's edge and grow from there. The nodes
under the rigid, frictionless punch move down together, so that no contact is searched. The pressure has no bound at the
edge, where quadratic elements are too stiff by a term that is linear in their size: two meshes give the limit.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
from scipy.sparse.linalg import splu

from references.soft_block import Block, Press, elements, with_midpoints

SIZE, YOUNG_MODULUS, POISSON_RATIO = (0.1, 0.1, 0.05), 1e5, 0.3
SIDES = (0.010, 0.013, 0.020, 0.030)
"""Sides of the punch [m]."""
CELLS = (2, 4)
"""Cells over half of a side."""
_GROWTH = 1.5


def ticks(cell: float, fine: float, length: float) -> np.ndarray:
    """Grid lines (n,) [m] from 0 to ``length``: equal cells to ``fine``, a line there, and cells that grow."""
    steps = [cell * _GROWTH]
    while sum(steps) < length - fine:
        steps.append(steps[-1] * _GROWTH)
    out = np.array(steps) * (length - fine) / sum(steps)
    return np.concatenate([np.linspace(0.0, fine, round(fine / cell) + 1), fine + np.cumsum(out)])


def stiffness(side: float, cells: int) -> float:
    """Force over depth [N/m] of a punch of this ``side`` [m] with ``cells`` over half of it."""
    half = 0.5 * side
    across = ticks(half / cells, half, 0.5 * SIZE[0])
    lines = across, across, SIZE[2] - ticks(half / cells, half, SIZE[2])[::-1]
    grid = np.stack(np.meshgrid(*map(with_midpoints, lines), indexing="ij"), axis=-1)
    points = grid.reshape(-1, 3)
    block = Block.of(points, elements(np.arange(len(points)).reshape(grid.shape[:3])), (0, 1), 1)
    whole = dataclasses.replace(block, free=np.arange(points.size))
    matrix = Press(whole, YOUNG_MODULUS, POISSON_RATIO, 1.0).tangent(np.zeros_like(points)).tocsr()
    under = (points[:, 2] > SIZE[2] - 1e-9) & (points[:, :2] < half + 1e-9).all(axis=1)
    moved, pushed = np.zeros(points.shape), np.zeros(points.shape, bool)
    moved[under, 2], pushed[under, 2] = -1.0, True
    free = np.setdiff1d(block.free, np.flatnonzero(pushed))
    u = moved.ravel()
    inner = matrix[free][:, free].tocsc()
    solver = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    u[free] = solver.solve(-(matrix @ u)[free])
    return -block.parts * float((matrix @ u).reshape(-1, 3)[under, 2].sum())


def main() -> None:
    """Compute and write the file."""
    found = [[stiffness(side, n) for n in CELLS] for side in SIDES]
    few, many = CELLS
    (Path(__file__).parent / "flat_punch.json").write_text(json.dumps({
        "quantity": "Force over depth of a flat square punch on the middle of S1's block at small strain",
        "setting": {"block_m": SIZE, "young_modulus_Pa": YOUNG_MODULUS, "poisson_ratio": POISSON_RATIO,
                    "base": "all displacements fixed at z = 0; the other faces are free",
                    "indenter": "rigid and frictionless"},
        "origin": "references/flat_punch.py: 27-node hexahedra, extrapolated linearly in the cell.",
        "relative_error": 0.01, "side_m": SIDES, "cells_over_half": CELLS, "stiffness_by_cells_N_per_m": found,
        "stiffness_N_per_m": [b + (b - a) * few / (many - few) for a, b in found]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
