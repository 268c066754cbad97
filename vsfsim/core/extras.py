"""Optional dependencies: which extra of vsfsim brings a package that is not installed, and the command for it.

Scores, datasets and leaderboards need numpy, scipy, h5py, typer and rich alone; everything else is in an extra.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from vsfsim.core.errors import VsfsimError

EXTRA_OF = {
    "warp": "sim", "mujoco": "sim", "trimesh": "sim", "pytetwild": "sim", "pyvista": "sim",
    "torch": "methods", "sklearn": "methods",
    "s3fs": "cloud", "ray": "ray", "pyarrow": "export", "yaml": "export",
    "gymnasium": "active", "matio": "recorded",
    "matplotlib": "render", "PIL": "render", "pyrender": "render",
}
"""The extra that a message names, by the name that is imported. `pyproject.toml` may list a package in several."""


class MissingPackage(VsfsimError, ModuleNotFoundError):
    """A package of an extra is not installed; the message names the extra."""


def missing(error: ModuleNotFoundError) -> MissingPackage | None:
    """The error that a user can act on, from what an import raised; None if no extra brings the missing module."""
    if isinstance(error, MissingPackage):
        return error
    package = (error.name or "").partition(".")[0]
    return _missing(package, EXTRA_OF[package]) if package in EXTRA_OF else None


def _missing(package: str, extra: str) -> MissingPackage:
    return MissingPackage(f"this needs the package '{package}', which is not installed. Install the extra '{extra}': "
                          f"{install_command(extra)} (\"[all]\" for everything).", name=package)


def install_command(extra: str) -> str:
    """What brings an extra: vsfsim is on no package index, so the command is for the checkout that this package lies
    in, or for any checkout if it was installed from a wheel."""
    root = Path(__file__).resolve().parents[2]
    if (root / "pyproject.toml").is_file():
        return f"cd '{root}' && pip install -e \".[{extra}]\""
    return f"in a checkout of vsfsim, pip install \".[{extra}]\""


def require(extra: str, *packages: str) -> None:
    """Called before ``packages`` are imported, by their names there.

    Raises:
        MissingPackage: one of them is not installed.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise _missing(package, extra)
