"""Presses of known force here and by a direct Newton method, on our tetrahedra: `vsfsim measure peers`.

`measurements/direct.py` has scikit-fem's elements and a Cholesky factor by CHOLMOD at every step, which ends at the
balance that our tier asks. It presses our mesh with quadratic tetrahedra, with linear ones, and with linear ones into
eight of which each of ours is cut, so that they have our nodes. Each press runs in a process of its own on one core.
Its cost begins with the mesh: it counts tables of elements and factors, and no loading of kernels or libraries.

S1, S2 and the block of foam are known for long: the local indentation was fitted on S1, the error that a foam is told
on the block of foam, and S2 is the product's own example. The other five are presses of `references/presses.json` that
had no force yet when the last constant that any press decided was set (`ELSEWHERE` of
`vsfsim/physics/mesh/resolved.py`, by 27 of them), and they are unlike what was fitted on:

- "box": a smaller block, a ball of half the radius beside its middle;
- "ball": a round body, held up to a third, whose faces are curved elements;
- "layered": a sheet 30 times as stiff, 5 mm under the top;
- "foam": another foam than the block's, under a smaller ball, deeper;
- "nu 0.49": nearly incompressible, under the smallest ball.

`vsfsim measure trust` presses them, too, but nothing was set by what it printed of them.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import references
import vsfsim
from measurements.kept import Kept
from measurements.measurement import Column, Measurement, Progress, Table, factorise
from measurements.stability.team import Ended, answers
from measurements.trust import cell_of
from references.cells import FOAMS, Cell
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import Scene, parse_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.provenance import commit
from vsfsim.generate.effectors.probe import prepare
from vsfsim.physics import tiers
from vsfsim.physics.elements.block import elements_of
from vsfsim.physics.linear.rest_factor import forget_all
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.physics.solve.touches import Solver

_BLOCK, _DISC, _BALL = ("box", 0.1, 0.1, 0.05), ("cylinder", 0.06, 0.03), ("sphere", 0.01)
CASES: dict[str, tuple[Cell, str]] = {
    "S1": (Cell(_BLOCK, ("sphere", 0.02), 0.005), "s1"),
    "S2": (Cell(_BLOCK, ("sphere", 0.02), 0.005, parts=(("sphere", 0.015, 0.038, 0.012, 100.0),)), "s2"),
    "block of foam": (Cell(_BLOCK, ("sphere", 0.02), 0.005, foam="pe-foam"), "foam_block"),
    "box": (Cell(("box", 0.06, 0.05, 0.03), _BALL, 0.003, at=0.013), "presses"),
    "ball": (Cell(("sphere", 0.025), _BALL, 0.003), "presses"),
    "layered": (Cell(_DISC, _BALL, 0.003, parts=(("layer", 0.02, 0.025, 30.0),)), "presses"),
    "foam": (Cell(_DISC, _BALL, 0.004, foam="ff-leap"), "presses"),
    "nu 0.49": (Cell(_DISC, ("sphere", 0.005), 0.002, 0.49), "presses")}
"""Press and file of `references/` by case."""
PEERS = ("quadratic", "linear", "linear, eight for one")
"""Tetrahedra of scikit-fem."""
EIGHT = ((0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (4, 5, 6, 8), (4, 6, 7, 8), (6, 7, 8, 9), (5, 6, 8, 9))
"""Nodes of the linear tetrahedra into which one of ten nodes is cut; the middle is cut along its edge from 6 to 8."""
MOST = 4.0 * 3600.0
"""Wall time after which a press is ended [s]."""


def known(case: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Depths (t,) [m] and forces (t,) [N] of a case, and the largest error of these [-]."""
    cell, file = CASES[case]
    curve = references.load(file)
    if file != "presses":
        return np.array(curve["depth_m"]), np.array(curve["force_N"]), curve["relative_error"]
    row = next(one for one in curve["presses"] if cell_of(one) == cell)
    count = len(row["force_N"])
    return cell.depth * np.arange(1, count + 1) / count, np.array(row["force_N"]), max(row["relative_error"])


def body_of(case: str, tier: str) -> tuple[Scene, Model]:
    """The scene of a case and its model at a tier, with the kernels that press it."""
    scene = parse_scene(CASES[case][0].scene(), Path("scene.toml")).sample(0)
    model = prepare(scene, Request(tier=tier)).model
    compile_kernels(solver_kernels(elements_of(model.blocks)), "cpu")
    return scene, model


def ours(case: str, tier: str, local: bool, depths: np.ndarray) -> dict[str, Any]:
    """The press by this solver, with or without the local indentation, on a mesh that exists; as `direct.run`."""
    scene, known_body = body_of(case, tier)
    cell = CASES[case][0]
    poses = np.tile(np.eye(4), (1 + len(depths), 1, 1, 1))
    poses[:, 0, 0, 3], poses[:, 0, 2, 3] = cell.at, cell.high + cell.probe[1] - np.append(0.0, depths)
    options = dataclasses.replace(tiers.options(tier), local_indentation=local)
    forget_all()
    began = time.process_time()
    model = tiers.model_of(scene, tier, known_body.solid, known_body.young_modulus)
    factorise(model)
    solver, ready = Solver(model, scene.probe, options=options), time.process_time()
    frames = solver.run(poses[1:], start=poses[0, :, None])
    return {"forces": frames.force[:, 0, 2].tolist(), "balance": frames.force_balance[:, 0].tolist(),
            "seconds": [time.process_time() - ready], "once": ready - began, "unknowns": int(model.free.sum())}


def theirs(case: str, tier: str, peer: str, depths: np.ndarray) -> dict[str, Any]:
    """The press by a peer on our mesh; as `direct.run`."""
    from measurements import direct  # needs scikit-fem and cvxopt

    cell, (_, model) = CASES[case][0], body_of(case, tier)
    mesh, young, parts = model.mesh, model.young_modulus.mean(axis=1), 8 if peer == PEERS[2] else 1
    tets = {PEERS[0]: mesh.tets, PEERS[1]: mesh.tets[:, :4], PEERS[2]: mesh.tets[:, EIGHT].reshape(-1, 4)}[peer]
    points = mesh.points[:tets.max() + 1]
    origins = np.array([cell.at, 0.0, cell.high]) - np.multiply.outer(depths, [0.0, 0.0, 1.0])
    return direct.run({
        "points": points, "tets": tets, "held": model.free.reshape(-1, 3)[:len(points), 0] == 0.0,
        "young": np.repeat(young, parts), "ratio": cell.nu, "foam": FOAMS.get(cell.foam, ()),
        "radius": cell.probe[1], "edge": model.element_size / np.cbrt(parts),
        "tolerance": tiers.options(tier).tolerance}, origins)


def compared(made: Mapping[str, Any], exact: np.ndarray) -> dict[str, Any]:
    """Errors of a curve of forces over the reference at each depth [-], as far as the curve goes, and its cost [s]."""
    error = np.array(made["forces"]) / exact[:len(made["forces"])] - 1.0
    if not len(error):
        return {"said": "no equilibrium at the first depth"}
    stopped = f"no equilibrium after {len(error)} of {len(exact)} depths" if len(error) < len(exact) else ""
    return {"first": float(error[0]), "full": None if stopped else float(error[-1]), "said": stopped,
            "rms": float(np.sqrt(np.mean(error**2))), "worst": float(error[np.abs(error).argmax()]),
            "balance": float(np.max(made["balance"])), "once": made["once"], "unknowns": made["unknowns"],
            "seconds": made["once"] + sum(made["seconds"])}


def measure(cases: Sequence[str] = (), *, tier: str = "fem-coarse", folder: Path = Path("peers"),
            progress: Progress = lambda said: None) -> Measurement:
    """The table.

    Args:
        cases: of `CASES`; empty for all.
        tier: whose mesh all press, and whose balance ends all.
        folder: of what was made; a later run goes on with it.
        progress: called with what is going on.

    Raises:
        VsfsimError: scikit-fem or cvxopt is not installed, or the folder is of another commit or tier.
    """
    if not all(map(importlib.util.find_spec, ("skfem", "cvxopt"))):
        raise VsfsimError("The peers need scikit-fem and CHOLMOD: pip install scikit-fem cvxopt")
    folder.mkdir(parents=True, exist_ok=True)
    lines = Kept(folder / "peers.jsonl", {"tier": tier, "version": vsfsim.__version__, "commit": commit()})
    rows = []
    for case in cases or CASES:
        depths, exact, unsure = known(case)
        works = {f"vsfsim, {tier}": partial(ours, local=True),
                 f"vsfsim, {tier}, no local indentation": partial(ours, local=False),
                 **{f"scikit-fem, {peer}": partial(theirs, peer=peer) for peer in PEERS}}
        body_of(case, tier)  # so that no press compiles a kernel
        for name, work in works.items():
            progress(f"{case}: {name}")
            made = lines.made(f"{case}: {name}", partial(row_of, case, partial(work, tier=tier, depths=depths), exact))
            rows.append({"case": case, "known": unsure, "peer": name, **made})
    return found_of(rows, {"tier": tier})


def row_of(case: str, work: Callable[[str], dict[str, Any]], exact: np.ndarray) -> dict[str, Any]:
    """What `compared` says of the case by this work, in a process of its own."""
    ((_, found),) = answers([case], work, workers=1, most=MOST)
    return {"said": found.words} if isinstance(found, Ended) else compared(found, exact)


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The measurement of these rows."""
    percent = partial(Column, unit="1", printed="%")
    columns = [Column("case", "case"), Column("peer", "simulator"), Column("unknowns", "unknowns", "1", form="d"),
               percent("known", "reference", form=".1f"), percent("first", "first depth", form="+.1f"),
               percent("full", "full depth", form="+.1f"), percent("rms", "rms", form=".1f"),
               percent("worst", "worst", form="+.1f"), Column("balance", "unbalanced", "1", form=".0e"),
               Column("once", "set-up", "s", form=".2g"), Column("seconds", "CPU in all", "s", form=".2g"),
               Column("said", "")]
    return Measurement.of("peers", settings, [Table(
        "Error of the force against references/, whose own error is at most that of its column, and processor time of "
        "the press", columns, rows, name="peers")], notes=[
            "scikit-fem: Newton's method with a new Cholesky factor by CHOLMOD in every step, from one symbolic factor "
            "with the order of AMD, until as little is unbalanced as the tier asks",
            "set-up: factors here, tables of elements and the symbolic factor there; the mesh, "
            "imports and the loading of kernels are not counted"])
