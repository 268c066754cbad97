"""Which code made a file: version and commit."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

import vsfsim


@functools.cache
def commit() -> str | None:
    """The git commit of this checkout, with "+changes" if tracked files differ from it; None in an installed wheel."""
    root = Path(vsfsim.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10,
                              check=True).stdout.strip()
        changes = subprocess.run(["git", "-C", str(root), "status", "--porcelain", "--untracked-files=no", "--",
                                  "vsfsim", "scenes", "baselines", "tasks"],
                                 capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+changes" if changes else "")


def made_by() -> dict[str, str | None]:
    """``{"vsfsim": version, "commit": commit or None}``."""
    return {"vsfsim": vsfsim.__version__, "commit": commit()}
