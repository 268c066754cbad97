"""Forces of the presses of `references/cells.py` by scikit-fem: `presses.json`.

    python -m references.presses made.jsonl --workers 16   # scikit-fem 12; goes on where made.jsonl ends
    python -m references.presses made.jsonl --ship         # writes them into presses.json, which keeps its others

Quadratic elements whose sides lie on every surface of the body and of its parts: 9-node quadrilaterals of the half
plane (r, z) where all is round about the z axis, 27-node hexahedra of a half or quarter of a box. The probe is rigid
and frictionless (`skfem_press.py`). Each press is made on meshes that differ by one factor, see `limit`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import skfem

import references
from references.cells import BASE, CELLS, FOAMS, FRAMES, HELD, Cell
from references.skfem_press import STIFF, Foam, NeoHooke, Press, gap_of

FILE = Path(__file__).with_suffix(".json")
FLAT, SOLID, FACTOR = (8.0, 12.0, 18.0), (2.5, 3.75), 1.5
"""Elements over the contact's radius, mesh by mesh, of the half plane and of a box; `FACTOR` apart."""


def lines(breaks: Sequence[float], size: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Grid lines (n,) through ``breaks`` [m], about ``size`` apart."""
    out = [np.array([min(breaks)])]
    for low, high in zip(sorted(breaks)[:-1], sorted(breaks)[1:]):
        if high - low > 1e-9:
            x = np.linspace(low, high, 400)
            whole = np.concatenate([[0.0], np.cumsum(np.diff(x) / size(0.5 * (x[1:] + x[:-1])))])
            out.append(np.interp(np.linspace(0.0, whole[-1], max(1, int(np.ceil(whole[-1]))) + 1)[1:], whole, x))
    return np.concatenate(out)


def rounded(points: np.ndarray, centre: np.ndarray, radius: float, outer: float) -> np.ndarray:
    """Points (d, n) moved so that the cube of half width ``radius`` about a centre (d,) becomes a ball; those past the
    half width ``outer`` stay."""
    x = points - centre[:, None]
    most = np.abs(x).max(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(most <= radius, most / radius, np.clip((outer - most) / (outer - radius + 1e-30), 0.0, 1.0))
        scale = 1.0 + share * (most / np.linalg.norm(x, axis=0) - 1.0)
    return centre[:, None] + np.where(most > 0.0, scale, 1.0) * x


def build(cell: Cell, fine: float) -> tuple[Press, np.ndarray]:
    """The press of a cell with ``fine`` elements over the contact's radius, and the probe's origins."""
    a, flat = cell.radius, cell.body[0] != "box"
    h, edges = a / fine, cell.probe[0] in ("cylinder", "box")
    wide = [cell.body[1]] if flat else [0.5 * v for v in cell.body[1:3]]
    whole = flat or (cell.at == 0.0 and not any(p[0] != "layer" for p in cell.parts))  # about x = 0, too
    spheres = [(p[1], p[2], p[3], min(1.5 * p[3], cell.high - p[2], p[2])) for p in cell.parts if p[0] == "sphere"]
    boxes = [p for p in cell.parts if p[0] == "box"]

    def near(x: np.ndarray, place: float, reach: float) -> np.ndarray:
        """Element size [m] along a side of the surface; smallest at the edge of a probe that has one."""
        away = np.abs(x - place)
        if edges:
            return h * np.minimum(0.15 + 1.2 * np.abs(away - reach) / a, 3.0 * 8.0)
        return h * (1.0 + 1.2 * np.maximum(away - 1.2 * reach, 0.0) / a)

    sides = [reach for reach in ((cell.probe[1],) if cell.probe[0] == "cylinder" else
                                 tuple(0.5 * v for v in cell.probe[1:]) if cell.probe[0] == "box" else (a,))]
    length = 0.5 * cell.probe[2] + a if cell.probe[0] == "capsule" else (sides[-1] if edges else a)
    xs = [0.0 if whole else -wide[0], wide[0], *(cell.at + s * sides[0] for s in ((1,) if whole else (-1, 1)) if edges),
          *(v for p in spheres for v in (p[0] + p[2], p[0] + p[3], *(() if whole else (p[0] - p[2], p[0] - p[3])))),
          *(v for p in boxes for v in (p[1], p[4])), *(() if whole else (cell.at,))]
    zs = [0.0, cell.high, *(v for p in cell.parts if p[0] == "layer" for v in p[1:3]),
          *(v for p in spheres for v in (p[1] - p[3], p[1] - p[2], p[1] + p[2], p[1] + p[3])),
          *(v for p in boxes for v in (p[3], p[5]))]
    axes = [lines(xs, lambda x: near(x, cell.at, sides[0]))]
    if not flat:
        axes.append(lines([0.0, wide[1], *([sides[-1]] if edges else []), *(p[2] for p in boxes)],
                          lambda y: near(y, 0.0, length)))
    axes.append(lines(zs, lambda z: h * ((0.15 if edges else 0.6) + 1.2 * (cell.high - z) / a)))
    plain = (skfem.MeshQuad if flat else skfem.MeshHex).init_tensor(*axes)
    middle = plain.p[:, plain.t].mean(axis=1)
    young = np.full(middle.shape[1], BASE)
    for kind, *p, ratio in cell.parts:
        if kind == "layer":
            inside = (middle[-1] > p[0]) & (middle[-1] < p[1])
        elif kind == "sphere":
            inside = np.maximum(np.abs(middle[0] - p[0]), np.abs(middle[-1] - p[1])) < p[2]
        else:
            inside = ((middle[0] > p[0]) & (middle[0] < p[3]) & (middle[1] < p[1]) & (middle[2] > p[2])
                      & (middle[2] < p[4]))
        young[inside] = ratio * BASE
    mesh = (skfem.MeshQuad2 if flat else skfem.MeshHex2).from_mesh(plain)
    points = mesh.doflocs
    for x, z, radius, outer in spheres:
        points = rounded(points, np.array([x, z]), radius, outer)
    if cell.body[0] == "sphere":
        points = rounded(points, np.array([0.0, cell.body[1]]), cell.body[1], cell.body[1])
    mesh = dataclasses.replace(mesh, doflocs=points)
    d, element = mesh.dim(), skfem.ElementVector(skfem.ElementQuad2() if flat else skfem.ElementHex2())
    basis = skfem.Basis(mesh, element, intorder=5)
    low = 0.88 * cell.high if cell.body[0] == "sphere" else cell.high - 1e-9  # clear of a ball's flattened corner
    up = mesh.facets_satisfying(lambda x: (x[-1] > low) & (x[0] > (1e-9 if whole else -1.0)), boundaries_only=True)
    face = skfem.FacetBasis(mesh, element, facets=up, intorder=15 if flat else 9)
    which = np.zeros(basis.N, int)
    for k, row in enumerate(basis.element_dofs):
        which[row] = k % d
    at = basis.doflocs
    held = at[-1] <= (HELD * cell.high if cell.body[0] == "sphere" else 1e-9)
    for axis in ([0] if whole else []) + ([] if flat else [1]):
        held |= (np.abs(at[axis]) < 1e-9) & (which == axis)
    law = Foam(FOAMS[cell.foam]) if cell.foam else NeoHooke(young[:, None], cell.nu)
    modulus = 3.0 * sum(mu for mu, _, _ in FOAMS[cell.foam]) if cell.foam else BASE
    press = Press(basis, face, law, np.flatnonzero(held), gap_of(cell.probe), penalty=STIFF * modulus / h,
                  parts=1.0 if flat else 4.0 if whole else 2.0)
    depths = cell.depth * np.arange(FRAMES + 1) / FRAMES
    origins = np.zeros((FRAMES + 1, d))
    origins[:, 0], origins[:, -1] = cell.at, cell.high - depths
    return press, origins


def limit(forces: Sequence[Sequence[float]], factor: float = FACTOR) -> tuple[np.ndarray, np.ndarray]:
    """Forces (t,) [N] that curves (2 or 3, t), coarse to fine and ``factor`` apart, tend to, and the
    error of each [-].

    One order for the whole curve, from the root mean squares of its two steps (Celik et al. 2008,
    10.1115/1.2960953), and 2 where there is one step. The error is 1.25 times the last correction, the whole step where
    there is one; the spread of the meshes where the order is not between 0.5 and 4.
    """
    made = np.asarray(forces)
    steps = np.diff(made, axis=0)
    sizes = np.sqrt((steps**2).mean(axis=1))
    order = 2.0 if len(steps) == 1 else float(np.log(max(sizes[0], 1e-300) / max(sizes[1], 1e-300)) / np.log(factor))
    more = steps[-1] / (factor ** min(max(order, 0.5), 4.0) - 1.0)
    if len(steps) == 1:
        found, error = made[-1] + more, np.abs(steps[-1])
    elif 0.5 <= order <= 4.0:
        found, error = made[-1] + more, 1.25 * np.abs(more)
    else:
        found, error = made[-1], 1.25 * np.ptp(made, axis=0)
    return found, error / np.abs(found)


def key_of(cell: Cell) -> str:
    """By which rows name it."""
    return json.dumps(dataclasses.asdict(cell))


def made(job: tuple[int, float]) -> dict[str, Any]:
    """One mesh of one cell, or why there is none."""
    number, fine = job
    began = time.process_time()
    row: dict[str, Any] = {"cell": number, "press": dataclasses.asdict(CELLS[number]), "fine": fine}
    try:
        press, origins = build(CELLS[number], fine)
        row |= {"unknowns": len(press.free), "force": press.curve(origins)}
    except Exception as error:  # scikit-fem raises a bare one; the other presses go on
        row["failed"] = f"{type(error).__name__}: {error}"
    return row | {"seconds": round(time.process_time() - began, 1)}


def main() -> None:
    """Make what the file lacks, or ship what it has."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--ship", action="store_true")
    given = parser.parse_args()
    rows = [json.loads(line) for line in given.file.read_text().splitlines()] if given.file.exists() else []
    if given.ship:
        ship(rows)
        return
    have = {(json.dumps(row["press"]), row["fine"]) for row in rows}
    jobs = [(k, fine) for k, cell in enumerate(CELLS) for fine in (SOLID if cell.body[0] == "box" else FLAT)]
    jobs.sort(key=lambda job: (CELLS[job[0]].body[0] != "box", -job[1]))  # what takes longest begins first
    with multiprocessing.get_context("spawn").Pool(given.workers, maxtasksperchild=1) as pool:
        for row in pool.imap_unordered(made, [job for job in jobs if (key_of(CELLS[job[0]]), job[1]) not in have]):
            with given.file.open("a") as out:
                out.write(json.dumps(row) + "\n")
            print(row["cell"], row["fine"], row.get("failed", "made"), row["seconds"], flush=True)


def ship(made_rows: Sequence[dict[str, Any]]) -> None:
    """Write `presses.json` of the cells that have two meshes or more, of which the finest count; one that has not
    keeps its row of the file."""
    out: list[dict[str, Any]] = []
    known = {json.dumps(row["press"]): row for row in references.load("presses")["presses"]}
    for cell in CELLS:
        own = sorted((row for row in made_rows if json.dumps(row["press"]) == key_of(cell) and "force" in row),
                     key=lambda row: row["fine"])
        meshes = own if tuple(row["fine"] for row in own) == FLAT else own[-2:]
        if len(meshes) > 1:
            force, error = limit([row["force"] for row in meshes], meshes[-1]["fine"] / meshes[-2]["fine"])
            out.append({"press": dataclasses.asdict(cell), "force_N": [float(f"{f:.6g}") for f in force],
                        "relative_error": [float(f"{e:.2g}") for e in error], "unknowns": own[-1]["unknowns"]})
        elif key_of(cell) in known:
            out.append(known[key_of(cell)])
    rows = ",\n  ".join(map(json.dumps, out))
    FILE.write_text(f'{{"quantity": "Normal force of a rigid probe at {FRAMES} equal parts of the deepest",\n'
                    f' "origin": "presses.py, scikit-fem {skfem.__version__}",\n "presses": [\n  {rows}\n ]}}\n')
    print(f"{len(out)} of {len(CELLS)} presses are in {FILE}")


if __name__ == "__main__":
    main()
