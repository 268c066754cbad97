"""S1, S2 and a block of foam pressed in other simulators, on our tetrahedra: `vsfsim measure peers`.

Each peer is a script of this folder that imports nothing of vsfsim, run by a Python of its own: a venv is made in the
folder that is given, and filled from the package registry. A peer of linear tetrahedra alone also presses a second
mesh, on which each of ours is cut into eight at the nodes of its edges. Errors are against the curves of `references/`.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
import venv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import references
from measurements.indent.pressing import key_of
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Sphere
from vsfsim.core.shelf import find_scene
from vsfsim.generate.effectors.probe import prepare
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver

CASES = {"S1": ("indent-homogeneous", "s1"), "S2": ("indent", "s2"),
         "foam": (str(Path(__file__).parent / "foam.toml"), "foam_block")}
"""Scene and reference by case."""
PEERS = {"scikit-fem": ("skfem_peer.py", "scikit-fem", False, True),
         "mujoco": ("mujoco_peer.py", "mujoco", True, False),
         "newton": ("newton_peer.py", "newton", True, False)}
"""Script of this folder, requirement, whether its tetrahedra are linear, and whether a foam's law can be given, by
peer."""
SHOWN = (0.0005, 0.001, 0.0025, 0.005)
"""Depths whose errors have a column [m]."""
LIMIT = 3600.0
"""A peer that takes longer for one case is stopped, and its line has the depths that it reached [s]."""
EIGHT = ((0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (4, 5, 6, 8), (4, 6, 7, 8), (6, 7, 8, 9), (5, 6, 8, 9))
"""Nodes of the linear tetrahedra into which one of ten nodes is cut; the middle is cut along its edge from 6 to 8."""


class Skipped(Exception):
    """A peer that cannot run here, with the reason."""


def python_of(peer: str, folder: Path | None, packages: Sequence[str]) -> Path:
    """The Python of a peer's venv in a folder, made and filled with packages if it is not there; this one without a
    folder.

    Raises:
        Skipped: its package cannot be installed.
    """
    if folder is None:
        return Path(sys.executable)
    where = folder / peer
    python = where / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    done = where / "installed"
    if not done.exists():
        venv.create(where, with_pip=True, clear=True)
        found = subprocess.run([str(python), "-m", "pip", "install", "-q", *packages], capture_output=True,
                               text=True)
        if found.returncode:
            why = [line for line in found.stderr.splitlines() if line.startswith("ERROR")] or ["pip failed"]
            raise Skipped(f"{packages[0]} cannot be installed here: {why[-1].removeprefix('ERROR: ')}")
        done.write_text("")
    return python


def pressed(peer: str, case: Path, folder: Path | None) -> dict[str, Any]:
    """What the script of a peer wrote, or had written before: what is there is not pressed again, however deep.

    Raises:
        Skipped: it cannot run, with the last line that it printed.
    """
    out, script = case.with_name(f"{case.stem}-{peer}.json"), Path(__file__).parent / PEERS[peer][0]
    given, why = dict(np.load(case)), ""
    if "foam" in given and not PEERS[peer][3]:
        raise Skipped("its solids have one law, which is not that of a foam")
    made = from_json(out.read_text()) if out.exists() else {}
    if made.get("key") != key_of(given, script):
        out.unlink(missing_ok=True)
        try:
            runner = Path(__file__).parent / "pressing.py"
            python = python_of(peer, folder, PEERS[peer][1:2])
            found = subprocess.run([str(python), *map(str, (runner, script, case, out))], capture_output=True,
                                   text=True, timeout=LIMIT)
            if found.returncode:
                why = f"its script ended with {(found.stderr.strip().splitlines() or ['no word'])[-1]}"
        except subprocess.TimeoutExpired:
            why = f"it took longer than {LIMIT:g} s"
        if not out.exists():
            raise Skipped(why)
        made = from_json(out.read_text())
    if "skipped" in made:
        raise Skipped(made["skipped"])
    reached = len(made["forces"])
    stopped = f"stopped at {1e3 * given['depths'][reached - 1]:g} mm after {sum(made['seconds']):.0f} s of CPU time"
    return {**made, "said": stopped if reached < len(given["depths"]) else ""}


def ours(name: str, tier: str, depths: np.ndarray, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """The press by this solver, as it is and without the local indentation, on the mesh that it leaves in the first of
    two files for the others, cut into eight in the second."""
    scene = load_scene(find_scene(name)).sample(0)
    model = prepare(scene, Request(tier=tier)).model
    assert isinstance(scene.probe, Sphere)
    mesh, corners = model.mesh, int(model.mesh.tets[:, :4].max()) + 1
    eight = mesh.tets[:, EIGHT].reshape(-1, 4)
    sides = mesh.points[eight[:, 1:]] - mesh.points[eight[:, :1]]
    eight[np.linalg.det(sides) < 0.0] = eight[np.linalg.det(sides) < 0.0][:, [0, 2, 1, 3]]
    law = scene.required_object.law
    foam = {} if law is None else {"foam": np.column_stack([law[1][row] for row in ("mu", "alpha", "beta")])}
    young, own = model.young_modulus.mean(axis=1), (mesh.points[:corners], mesh.tets[:, :4], 1)
    for file, (points, tets, parts) in zip(files, (own, (mesh.points, eight, 8)), strict=True):
        np.savez(file, points=points, tets=tets, young=np.repeat(young, parts), radius=scene.probe.radius,
                 ratio=scene.required_object.poisson_ratio, edge=model.element_size / np.cbrt(parts), depths=depths,
                 at=np.zeros(2), **foam)
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    poses[:, 0, 2, 3] = mesh.points[:, 2].max() + scene.probe.radius - depths
    out = {}
    for words, local in ((tier, True), (f"{tier}, no local indentation", False)):
        options = dataclasses.replace(tiers.options(tier), local_indentation=local)
        solver = Solver(model, scene.probe, options=options)
        solver.run(poses[:1])  # kernels and factor
        began = time.process_time()
        frames = solver.run(poses)
        spent = time.process_time() - began
        out[words] = {"forces": frames.force[:, 0, 2].tolist(), "balance": frames.force_balance[:, 0].tolist(),
                      "seconds": [spent / len(depths)] * len(depths), "tets": len(mesh.tets), "said": ""}
    return out


def compared(made: Mapping[str, Any], depths: np.ndarray, exact: np.ndarray) -> dict[str, Any]:
    """Errors of a curve of forces, each over the reference at its depth [-], as far as the curve goes."""
    error = np.array(made["forces"]) / exact[:len(made["forces"])] - 1.0
    at = {f"at_{1e3 * depth:g}".replace(".", "_"): float(error[k]) for depth in SHOWN
          for k in np.flatnonzero(np.isclose(depths[:len(error)], depth))}
    return {**at, "rms": float(np.sqrt(np.mean(error**2))), "worst": float(error[np.abs(error).argmax()]),
            "balance": float(np.max(made["balance"])), "seconds": float(np.mean(made["seconds"])),
            "tets": made["tets"], "said": made["said"]}


def measure(peers: Sequence[str] = (), cases: Sequence[str] = (), *, tier: str = "fem", folder: Path = Path("peers"),
            here: bool = False, progress: Progress = lambda said: None) -> Measurement:
    """The table.

    Args:
        peers: keys of `PEERS`; empty for all. cases: of `CASES`; empty for all.
        tier: whose mesh all press.
        folder: of the venvs and of what was made; a later run goes on with it.
        here: use this Python, which has the packages, in place of venvs.
        progress: called with what is going on.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    settings: dict[str, str] = {}
    for case in cases or CASES:
        name, reference = CASES[case]
        curve = references.load(reference)
        depths, exact = np.array(curve["depth_m"]), np.array(curve["force_N"])
        files = [(folder / f"{case}-{tier}{end}.npz").absolute() for end in ("", "-eighths")]
        progress(f"{case}: ours")
        rows += [{"case": case, "peer": f"vsfsim, {words}", **compared(own, depths, exact)}
                 for words, own in ours(name, tier, depths, files).items()]
        for peer in peers or PEERS:
            for file in files[:1 + PEERS[peer][2]]:
                progress(f"{case}: {peer}, {file.stem}")
                try:
                    made = pressed(peer, file, None if here else folder)
                except Skipped as skipped:
                    rows.append({"case": case, "peer": peer, "said": f"skipped: {skipped}"})
                    break
                settings[f"{peer} {made['version']}"] = made["settings"]
                rows.append({"case": case, "peer": f"{peer} {made['version']}", **compared(made, depths, exact)})
    return found_of(rows, {"peers": list(peers), "tier": tier, "settings": settings})


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The measurement of these rows."""
    columns = [Column("case", "case"), Column("peer", "simulator"), Column("tets", "tetrahedra", "1", "", "d"),
               *(Column(f"at_{1e3 * d:g}".replace(".", "_"), f"{1e3 * d:g} mm", "1", "%", "+.1f") for d in SHOWN),
               Column("rms", "rms", "1", "%", ".1f"), Column("worst", "worst", "1", "%", "+.1f"),
               Column("balance", "unbalanced", "1", "", ".0e"), Column("seconds", "CPU s a frame", "1", "", ".2g"),
               Column("said", "")]
    return Measurement.of("peers", settings, [
        Table("Error of the force along the depths of references/, at four of them and over all", columns, rows,
              name="peers")], notes=[f"{peer}: {said}" for peer, said in settings["settings"].items()])
