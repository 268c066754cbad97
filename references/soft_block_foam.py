"""Sphere pressed into a block of foam: an independent computation of the foam case (`foam_block.json`).

    python references/soft_block_foam.py             # three meshes, Richardson extrapolation
    python references/soft_block_foam.py --cell 7.5  # one mesh

The mechanics are those of `soft_block.py` on one quarter of the block, with the law of `hyperfoam.py`. NumPy and SciPy
only.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from references import hyperfoam  # noqa: E402
from references.soft_block import Block, Press, curve, report  # noqa: E402


class FoamPress(Press):
    """The block of foam under the sphere.

    Args:
        block: the mesh.
        rows: mu [Pa], alpha and beta of each term (k, 3).
        radius: of the sphere [m].
    """

    def __init__(self, block: Block, rows: np.ndarray, radius: float):
        super().__init__(block, 1.0, 0.0, radius)
        self.rows = rows

    def density(self, f: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Energy (m, 27) [Pa]."""
        return hyperfoam.energy(f, self.rows)

    def stress(self, f: np.ndarray) -> np.ndarray:
        """First Piola-Kirchhoff stress (m, 27, 3, 3) [Pa]."""
        return hyperfoam.stress(f, self.rows)

    def stiffness(self, f: np.ndarray) -> np.ndarray:
        """Of the elements (m, 27, 3, 27, 3) [N/m]."""
        b = self.block
        moduli = b.weights[..., None, None, None, None] * hyperfoam.moduli(f, self.rows)
        half = np.einsum("mqijkl,mqbl->mqijbk", moduli, b.gradients, optimize=True)
        return np.einsum("mqijbk,mqaj->maibk", half, b.gradients, optimize=True)


def foam(cell: float, setting: dict[str, Any]) -> FoamPress:
    """The press on cells of ``cell`` [m] at the contact; ``setting``: that of `foam_block.json`."""
    block = Block.quarter(tuple(setting["block_m"]), cell, even=0.015, growth=1.4, face_points=6)
    return FoamPress(block, np.array(setting["mu_alpha_beta"]), 0.02)


def main() -> None:
    """Compute the case on each mesh, extrapolate, and compare with `foam_block.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", type=float, nargs="+", default=[7.5, 5.0, 3.8], help="cells at the contact [mm]")
    parser.add_argument("--depth", type=float, nargs="+", default=[1.0, 2.5, 5.0], help="depths [mm]")
    given = parser.parse_args()
    data = json.loads((HERE / "foam_block.json").read_text())
    depths = [1e-3 * d for d in given.depth]
    forces = np.array([curve(foam(1e-3 * cell, data["setting"]), depths) for cell in given.cell])
    report(given.cell, depths, forces, data)


if __name__ == "__main__":
    main()
