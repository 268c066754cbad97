"""fTetWild (Hu et al. 2020) through pytetwild: fills a surface that may cross itself, and has walls of any thickness.

Its mesh differs from run to run, even with one thread: it is asked for where a regular lattice does not do, and what
it made is kept.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.core.errors import MeshError
from vsfsim.core.extras import require

if TYPE_CHECKING:
    from vsfsim.physics.mesh.repair import Surface

# fTetWild runs in a process and a folder of its own: it leaves "__tracked_surface.stl" in the working directory, and
# may crash on a mesh that it cannot fill. Its package imports PyVista, which takes most of such a process, only to add
# a function to its meshes; a module without functions is to it a PyVista that is too old for that.
_FILLER = """
import resource, sys, types
import numpy as np
given = np.load(sys.argv[1])
resource.setrlimit(resource.RLIMIT_CPU, (int(given["seconds"]),) * 2)
sys.modules["pyvista"] = types.ModuleType("pyvista")
import pytetwild
vertices, tets = pytetwild.tetrahedralize(given["vertices"], given["faces"], edge_length_abs=float(given["resolution"]),
                                          epsilon=float(given["envelope"]), num_threads=1, quiet=True)
np.savez(sys.argv[2], vertices=vertices, tets=tets)
"""
CPU_LIMIT = 60
"""Processor time after which the filler is stopped [s]; the load of the machine has no say."""


def run(surface: Surface, resolution: float, envelope: float, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and tetrahedra (m, 4), of either orientation, inside a surface.

    Args:
        surface: what is filled.
        resolution: edge length [m].
        envelope: how far the surface may move, over its diagonal [-].
        path: of the mesh file, for messages.

    Raises:
        MissingPackage: pytetwild is not installed.
        MeshError: the filler failed, or took more processor time than `CPU_LIMIT`.
    """
    require("sim", "pytetwild")
    print(f"{path.name}: fTetWild fills it, in at most {CPU_LIMIT} s of processor time", file=sys.stderr)
    with tempfile.TemporaryDirectory(prefix="vsfsim-fill-") as folder:
        given, made = Path(folder, "given.npz"), Path(folder, "made.npz")
        np.savez(given, vertices=np.asarray(surface.vertices, np.float64), faces=np.asarray(surface.faces, np.int32),
                 resolution=resolution, envelope=envelope, seconds=CPU_LIMIT)
        filler = subprocess.run([sys.executable, "-c", _FILLER, str(given), str(made)], cwd=folder, text=True,
                                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, errors="replace")
        if filler.returncode != 0 or not made.exists():
            said = filler.stdout.strip().splitlines() or [f"it was stopped with status {filler.returncode}, as it is "
                                                          f"after {CPU_LIMIT} s of processor time"]
            raise MeshError(f"mesh file '{path}' could not be filled with tetrahedra of {resolution:g} m: {said[-1]}. "
                            "Use a coarser resolution, or repair the mesh by hand (e.g. in MeshLab).")
        with np.load(made, allow_pickle=False) as data:
            return data["vertices"].astype(np.float64), data["tets"].astype(np.int64)
