"""Mesh files for the stability map: a block with one defect, and a pyramid as a probe."""

from __future__ import annotations

from pathlib import Path

import numpy as np

WIDTH, HEIGHT, CELLS = 0.04, 0.02, 4  # of the block [m], and squares along each edge of a face


def write_block(path: Path, defect: str) -> None:
    """Write a block of 40 x 40 x 20 mm as OBJ.

    Args:
        path: the file.
        defect: one of the levels of `design.INPUT`.
    """
    if defect == "empty file":
        path.write_text("")
        return
    vertices, triangles = _grid_box(np.array([WIDTH, WIDTH, HEIGHT]))
    top = int(np.argmax(vertices[triangles].mean(axis=1)[:, 2]))
    match defect:
        case "none":
            pass
        case "flipped triangle":
            triangles[top] = triangles[top, ::-1]
        case "all flipped":
            triangles = triangles[:, ::-1]
        case "hole":
            triangles = np.delete(triangles, [top, top + 1], axis=0)
        case "sliver":  # a vertex 1e-7 of an edge beside another's edge: two triangles of no height to speak of
            a, b, c = triangles[top]
            middle = 0.5 * (vertices[a] + vertices[b]) + 1e-7 * (vertices[c] - vertices[a])
            vertices = np.vstack([vertices, middle])
            new = len(vertices) - 1
            triangles = np.vstack([np.delete(triangles, top, axis=0), [[a, b, new], [b, c, new], [c, a, new]]])
        case "needle":  # a spike of 0.05 mm breadth and 5 mm height on the top
            a, b, c = triangles[top]
            centre = vertices[[a, b, c]].mean(axis=0)
            ring = centre + 2.5e-5 * np.array([[np.cos(t), np.sin(t), 0.0] for t in (0.0, 2.1, 4.2)])
            n = len(vertices)
            vertices = np.vstack([vertices, ring, centre + [0.0, 0.0, 0.005]])
            triangles = np.vstack([triangles, [[n, n + 1, n + 3], [n + 1, n + 2, n + 3], [n + 2, n, n + 3],
                                               [n + 2, n + 1, n]]])
        case "doubled triangle":
            triangles = np.vstack([triangles, triangles[top]])
        case "degenerate triangle":
            triangles = np.vstack([triangles, [triangles[top, 0], triangles[top, 1], triangles[top, 0]]])
        case "two bodies":
            triangles = np.vstack([triangles, triangles + len(vertices)])
            vertices = np.vstack([vertices, vertices + [2.0 * WIDTH, 0.0, 0.0]])
        case "sheet":
            vertices = vertices * [1.0, 1.0, 0.0]
        case "self-crossing":  # one corner is pulled through the opposite side
            corner = int(np.argmax(vertices @ [1.0, 1.0, 1.0]))
            vertices[corner] = [-0.7 * WIDTH, -0.7 * WIDTH, -0.5 * HEIGHT]
        case "millimetres":
            vertices = 1e3 * vertices
        case "not a number":
            vertices[0, 0] = np.nan
        case _:
            raise AssertionError(defect)
    _write(path, vertices, triangles)


def write_pyramid(path: Path, edge: float) -> None:
    """Write a square pyramid as OBJ, its tip down; base and height are ``edge`` [m]."""
    half = 0.5 * edge
    vertices = np.array([[-half, -half, half], [half, -half, half], [half, half, half], [-half, half, half],
                         [0.0, 0.0, -half]])
    _write(path, vertices, np.array([[0, 1, 2], [0, 2, 3], [1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4]]))


def _grid_box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A box on z = 0 around the z axis, its faces cut into squares: vertices (n, 3) [m], triangles (f, 3) outward."""
    points: list[np.ndarray] = []
    triangles: list[list[int]] = []
    ticks = np.linspace(-0.5, 0.5, CELLS + 1)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-0.5, 0.5):
            first = len(points)
            for a in ticks:
                for b in ticks:
                    p = np.zeros(3)
                    p[axis], p[u], p[v] = side, a, b
                    points.append(p)
            for i in range(CELLS):
                for j in range(CELLS):
                    p = first + i * (CELLS + 1) + j
                    q, r, s = p + CELLS + 1, p + CELLS + 2, p + 1
                    both = [[p, q, r], [p, r, s]]
                    triangles += both if side > 0 else [t[::-1] for t in both]
    rounded, same = np.unique(np.round(np.array(points), 6), axis=0, return_inverse=True)
    return (rounded + [0.0, 0.0, 0.5]) * size, same.ravel()[np.array(triangles)]


def _write(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    path.write_text("".join([*(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist()),
                             *(f"f {a} {b} {c}\n" for a, b, c in (triangles + 1).tolist())]))
