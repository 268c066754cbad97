"""Sphere pressed into a soft block with a stiff inclusion: an independent computation of S2 (`s2.json`).

    python references/soft_block_inclusion.py             # three meshes, Richardson extrapolation
    python references/soft_block_inclusion.py --across 4  # one mesh

The mechanics are those of `soft_block.py`, on one half of the block (y >= 0). The hexahedra conform to the inclusion:
a box around it holds a core, a layer of elements from the core to the sphere, and layers from the sphere to the box;
outside the box the mesh is a graded grid. The top of the box is the top of the block. The inclusion touches the top
face at one point, where an element would have no height, so it is lowered by 20 um. NumPy and SciPy only.
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

from references.soft_block import Block, Press, curve, elements, report, ticks, with_midpoints  # noqa: E402

LOWERED = 2e-5
"""Distance by which the inclusion is lowered [m]."""
MARGIN = 1.25
"""Half the width of the box over the radius of the inclusion [-]."""
CORE = 0.45
"""Half the width of the core over the radius of the inclusion [-]."""


def around_sphere(radius: float, box: np.ndarray, across: int, layers: int) -> tuple[np.ndarray, np.ndarray]:
    """Elements of the half y >= 0 of a box with a sphere at the origin.

    Args:
        radius: of the sphere [m]. box: lower and upper corner of the whole box (2, 3) [m].
        across: elements along an edge of the whole box; even. layers: of elements between the sphere and the box.

    Returns:
        Nodes of the elements (m, 27, 3) [m], and whether each lies in the sphere (m,).
    """
    line = np.linspace(-1.0, 1.0, 2 * across + 1)
    half = line[across:]
    core = CORE * radius * np.stack(np.meshgrid(line, half, line, indexing="ij"), axis=-1)
    found, inside = [elements(core)], [np.ones(across**3 // 2, bool)]
    for axis, side in ((0, -1), (0, 1), (1, 1), (2, -1), (2, 1)):
        lines = [half if k == 1 else line for k in range(3)]
        lines[axis] = np.array([float(side)])
        cube = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).squeeze(axis)
        ball = np.tan(0.25 * np.pi * cube)
        ball *= radius / np.linalg.norm(ball, axis=-1, keepdims=True)
        shell = np.where(cube < 0.0, -cube * box[0], cube * box[1])
        for low, high, count, stiff in ((CORE * radius * cube, ball, 1, True), (ball, shell, layers, False)):
            t = np.linspace(0.0, 1.0, 2 * count + 1)[:, None, None, None]
            part = elements((1.0 - t) * low + t * high)
            found.append(part)
            inside.append(np.full(len(part), stiff))
    return np.concatenate(found), np.concatenate(inside)


def right_handed(corners: np.ndarray) -> np.ndarray:
    """The elements (m, 27, 3) with the order of the nodes reversed along the first axis where it is left-handed."""
    grid = corners.reshape(-1, 3, 3, 3, 3)
    edges = np.stack([grid[:, 2, 1, 1] - grid[:, 0, 1, 1], grid[:, 1, 2, 1] - grid[:, 1, 0, 1],
                      grid[:, 1, 1, 2] - grid[:, 1, 1, 0]], axis=1)
    left = np.linalg.det(edges) < 0.0
    return np.where(left[:, None, None, None, None], grid[:, ::-1], grid).reshape(-1, 27, 3)


def half_block(size: tuple[float, float, float], centre: np.ndarray, radius: float, across: int, layers: int, *,
               growth: float = 1.8, face_points: int = 6) -> tuple[Block, np.ndarray]:
    """Half of a block of ``size`` [m] with an inclusion of ``radius`` [m] at ``centre`` (3,) [m] on the plane y = 0.

    ``across`` and ``layers``: see :func:`around_sphere`. Outside the box the cells grow by ``growth``.

    Returns:
        The mesh, and whether each element lies in the inclusion (m,).
    """
    width = MARGIN * radius
    box = np.array([[-width] * 3, [width, width, size[2] - centre[2]]])
    cell = 2.0 * width / across
    inner, stiff = around_sphere(radius, box, across, layers)
    low, high = centre + box
    x = np.concatenate([low[0] - ticks(cell, 0.01, low[0] + 0.5 * size[0], growth, 0.6)[:0:-1],
                        np.linspace(low[0], high[0], across + 1),
                        high[0] + ticks(cell, cell, 0.5 * size[0] - high[0], growth, 0.6)[1:]])
    y = np.concatenate([np.linspace(0.0, high[1], across // 2 + 1),
                        high[1] + ticks(cell, cell, 0.5 * size[1] - high[1], growth, 0.6)[1:]])
    z = np.concatenate([low[2] - ticks(cell, cell, low[2], growth, 0.6)[:0:-1],
                        np.linspace(low[2], centre[2], across // 2 + 1),
                        np.linspace(centre[2], high[2], across // 2 + 1)[1:]])
    z[0] = 0.0
    outer = elements(np.stack(np.meshgrid(*map(with_midpoints, (x, y, z)), indexing="ij"), axis=-1))
    middle = outer[:, 13]  # the middle node
    outer = outer[~((middle > low) & (middle < high)).all(axis=1)]
    corners = np.concatenate([right_handed(inner) + centre, outer])
    # the nodes of neighbouring parts agree to rounding; distinct nodes lie micrometres apart
    _, first, number = np.unique(np.rint(corners.reshape(-1, 3) / 1e-8), axis=0, return_index=True,
                                 return_inverse=True)
    points = corners.reshape(-1, 3)[first]
    points[np.abs(points) < 1e-12] = 0.0
    block = Block.of(points, number.reshape(-1, 27), (1,), face_points)
    return block, np.concatenate([stiff, np.zeros(len(outer), bool)])


def s2(across: int, setting: dict[str, Any]) -> Press:
    """The press of S2 with ``across`` elements along the box of the inclusion; ``setting``: that of `s2.json`."""
    inclusion = setting["inclusion"]
    centre = np.array(inclusion["centre_m"]) - [0.0, 0.0, LOWERED]
    block, stiff = half_block(tuple(setting["block_m"]), centre, inclusion["radius_m"], across, max(1, across // 4))
    modulus = np.where(stiff, inclusion["young_modulus_Pa"], setting["young_modulus_Pa"])
    return Press(block, modulus, setting["poisson_ratio"], 0.02)


def main() -> None:
    """Compute S2 on each mesh, extrapolate, and compare with `s2.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--across", type=int, nargs="+", default=[2, 4, 6], help="elements along the inclusion's box")
    parser.add_argument("--depth", type=float, nargs="+", default=[2.5, 5.0], help="depths [mm]")
    given = parser.parse_args()
    data = json.loads((HERE / "s2.json").read_text())
    depths = [1e-3 * d for d in given.depth]
    forces = np.array([curve(s2(across, data["setting"]), depths) for across in given.across])
    width = 2e3 * MARGIN * data["setting"]["inclusion"]["radius_m"]
    report([width / across for across in given.across], depths, forces, data)


if __name__ == "__main__":
    main()
