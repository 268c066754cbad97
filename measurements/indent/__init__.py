"""S1 and S2 pressed in other simulators, on our tetrahedra: `vsfsim measure peers`.

Each peer is a script of this folder that imports nothing of vsfsim, run by a Python of its own: a venv is made in the
folder that is given, and filled from the package registry. Errors are against the curves of `references/`.
"""

from __future__ import annotations

import subprocess
import sys
import time
import venv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import references
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import load_scene
from vsfsim.core.shape import Sphere
from vsfsim.core.shelf import find_scene
from vsfsim.generate.press_result import PressRequest
from vsfsim.generate.presses.probe import prepare
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver

CASES = {"S1": ("indent-homogeneous", "s1"), "S2": ("indent", "s2")}
PEERS = {"scikit-fem": ("skfem_peer.py", "scikit-fem"), "mujoco": ("mujoco_peer.py", "mujoco")}
"""Script of this folder and requirement by peer."""
LIMIT = 3600.0
"""A peer that takes longer for one case is stopped [s]."""


class Skipped(Exception):
    """A peer that cannot run here, with the reason."""


def python_of(peer: str, folder: Path | None) -> Path:
    """The Python of a peer's venv in a folder, made and filled if it is not there; this one without a folder.

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
        found = subprocess.run([str(python), "-m", "pip", "install", "-q", PEERS[peer][1]], capture_output=True,
                               text=True)
        if found.returncode:
            why = [line for line in found.stderr.splitlines() if line.startswith("ERROR")] or ["pip failed"]
            raise Skipped(f"{PEERS[peer][1]} cannot be installed here: {why[-1].removeprefix('ERROR: ')}")
        done.write_text("")
    return python


def pressed(peer: str, case: Path, folder: Path | None) -> dict[str, Any]:
    """What the script of a peer wrote.

    Raises:
        Skipped: it cannot run, with the last line that it printed.
    """
    out = case.with_name(f"{case.stem}-{peer}.json")
    script = Path(__file__).parent / PEERS[peer][0]
    try:
        found = subprocess.run([str(python_of(peer, folder)), str(script), str(case), str(out)], capture_output=True,
                               text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        raise Skipped(f"it took longer than {LIMIT:g} s") from None
    if found.returncode:
        raise Skipped(f"its script ended with {(found.stderr.strip().splitlines() or ['no word'])[-1]}")
    made = from_json(out.read_text())
    if "skipped" in made:
        raise Skipped(made["skipped"])
    return made


def ours(name: str, tier: str, depths: np.ndarray, file: Path) -> dict[str, Any]:
    """The press by this solver, on the mesh that it leaves in ``file`` for the others."""
    scene = load_scene(find_scene(name)).sample(0)
    model = prepare(scene, PressRequest(tier=tier)).model
    assert isinstance(scene.probe, Sphere)
    mesh, corners = model.mesh, int(model.mesh.tets[:, :4].max()) + 1
    np.savez(file, points=mesh.points[:corners], tets=mesh.tets[:, :4], young=model.young_modulus.mean(axis=1),
             ratio=scene.required_object.poisson_ratio, radius=scene.probe.radius, edge=model.element_size,
             depths=depths, at=np.zeros(2))
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    poses[:, 0, 2, 3] = mesh.points[:, 2].max() + scene.probe.radius - depths
    solver = Solver(model, scene.probe, options=tiers.options(tier))
    solver.run(poses[:1])  # kernels and factor
    began = time.process_time()
    frames = solver.run(poses)
    spent = time.process_time() - began
    return {"forces": frames.force[:, 0, 2].tolist(), "balance": frames.force_balance[:, 0].tolist(),
            "seconds": [spent / len(depths)] * len(depths), "tets": len(mesh.tets)}


def compared(made: Mapping[str, Any], exact: np.ndarray) -> dict[str, float]:
    """Errors of a curve of forces, each over the reference at its depth [-]."""
    error = np.array(made["forces"]) / exact - 1.0
    return {"full": float(error[-1]), "rms": float(np.sqrt(np.mean(error**2))),
            "worst": float(error[np.abs(error).argmax()]), "balance": float(np.max(made["balance"])),
            "seconds": float(np.mean(made["seconds"]))}


def measure(peers: Sequence[str] = (), cases: Sequence[str] = (), *, tier: str = "fem", folder: Path = Path("peers"),
            here: bool = False, progress: Progress = lambda said: None) -> Measurement:
    """The table.

    Args:
        peers: keys of `PEERS`; empty for all. cases: of `CASES`; empty for all.
        tier: whose mesh all press.
        folder: of the venvs and of what was made.
        here: use this Python, which has the packages, in place of venvs.
        progress: called with what is going on.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for case in cases or CASES:
        name, reference = CASES[case]
        curve = references.load(reference)
        depths, exact = np.array(curve["depth_m"]), np.array(curve["force_N"])
        file = (folder / f"{case}-{tier}.npz").absolute()
        progress(f"{case}: ours")
        own = ours(name, tier, depths, file)
        rows.append({"case": case, "peer": f"vsfsim, {tier}", "tets": own["tets"], **compared(own, exact), "said": ""})
        for peer in peers or PEERS:
            progress(f"{case}: {peer}")
            try:
                made = pressed(peer, file, None if here else folder)
            except Skipped as skipped:
                rows.append({"case": case, "peer": peer, "said": f"skipped: {skipped}"})
                continue
            rows.append({"case": case, "peer": f"{peer} {made['version']}", "tets": own["tets"],
                         **compared(made, exact), "said": ""})
    if not rows:
        raise VsfsimError("no case was asked for.")
    columns = [Column("case", "case"), Column("peer", "simulator"), Column("tets", "tetrahedra", "1", "", "d"),
               Column("full", "error at full depth", "1", "%", "+.1f"), Column("rms", "rms", "1", "%", ".1f"),
               Column("worst", "worst", "1", "%", "+.1f"), Column("balance", "unbalanced", "1", "", ".0e"),
               Column("seconds", "CPU s a frame", "1", "", ".2g"), Column("said", "")]
    return Measurement.of("peers", {"peers": list(peers), "tier": tier}, [
        Table("Force along the depths of references/, on the same tetrahedra", columns, rows, name="peers")])
