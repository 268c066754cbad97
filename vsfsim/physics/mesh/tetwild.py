"""fTetWild (Hu et al. 2020) through pytetwild: fills a surface that may cross itself, and has walls of any thickness.

Its mesh differs from run to run, even with one thread: it is asked for where a regular lattice does not do, and what
it made is kept.
"""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.core.errors import MeshError
from vsfsim.core.extras import require

if TYPE_CHECKING:
    from vsfsim.physics.mesh.repair import Surface

# fTetWild runs in a process and a folder of its own: it leaves "__tracked_surface.stl" in the working directory, and
# may crash on a mesh that it cannot fill.
# fTetWild's package imports PyVista, which takes most of such a process, only to add a function to its meshes; a module
# without functions is to it a PyVista that is too old for that.
_FILLER = """
import sys
import types
import numpy as np
sys.modules["pyvista"] = types.ModuleType("pyvista")
import pytetwild
given = np.load(sys.argv[1])
vertices, tets = pytetwild.tetrahedralize(given["vertices"], given["faces"], edge_length_abs=float(given["resolution"]),
                                          epsilon=float(given["envelope"]), num_threads=1, quiet=True)
np.savez(sys.argv[2], vertices=vertices, tets=tets)
"""
TIME_LIMIT = 60.0
"""Time after which the filler is stopped [s]."""
_TOLD = 5.0  # time between two words of progress [s]


def version() -> str:
    """Of pytetwild; "none" without it, as most scans do without."""
    try:
        return importlib.metadata.version("pytetwild")
    except importlib.metadata.PackageNotFoundError:
        return "none"


def run(surface: Surface, resolution: float, envelope: float, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and tetrahedra (m, 4), of either orientation, inside a surface.

    Args:
        surface: what is filled.
        resolution: edge length [m].
        envelope: how far the surface may move, over its diagonal [-].
        path: of the mesh file, for messages.

    Raises:
        MissingPackage: pytetwild is not installed.
        MeshError: the filler failed, or took more than `TIME_LIMIT`.
    """
    require("sim", "pytetwild")
    with tempfile.TemporaryDirectory(prefix="vsfsim-fill-") as folder:
        given, made, said = (Path(folder, name) for name in ("given.npz", "made.npz", "said.txt"))
        np.savez(given, vertices=np.asarray(surface.vertices, np.float64), faces=np.asarray(surface.faces, np.int32),
                 resolution=resolution, envelope=envelope)
        with said.open("wb") as words:
            filler = subprocess.Popen([sys.executable, "-c", _FILLER, str(given), str(made)], cwd=folder,
                                      stdout=words, stderr=words)
            reason = _wait(filler, path)
        reason = reason or (said.read_text(errors="replace").strip().splitlines()
                            or [f"it ended with status {filler.returncode}"])[-1]
        if filler.returncode != 0 or not made.exists():
            raise MeshError(f"mesh file '{path}' could not be filled with tetrahedra of {resolution:g} m: {reason}. "
                            "Use a coarser resolution, or repair the mesh by hand (e.g. in MeshLab).")
        with np.load(made, allow_pickle=False) as data:
            return data["vertices"].astype(np.float64), data["tets"].astype(np.int64)


def _wait(filler: subprocess.Popen[bytes], path: Path) -> str:
    """Why the filler was stopped, or "" if it ended by itself; progress goes to stderr."""
    began = time.monotonic()
    try:
        while (passed := time.monotonic() - began) < TIME_LIMIT:
            try:
                filler.wait(timeout=min(_TOLD, TIME_LIMIT - passed))
                return ""
            except subprocess.TimeoutExpired:
                print(f"{path.name}: fTetWild fills it, {time.monotonic() - began:.0f} s of at most {TIME_LIMIT:.0f} s",
                      file=sys.stderr)
        return f"fTetWild took more than {TIME_LIMIT:g} s"
    finally:
        if filler.poll() is None:
            filler.kill()
            filler.wait()
