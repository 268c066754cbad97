"""Which code made a file: version and commit."""

from __future__ import annotations

import functools
import os
import re
import subprocess
from pathlib import Path

import vsfsim
from vsfsim.core.errors import VsfsimError

VARIABLE = "VSFSIM_COMMIT"
"""Environment variable that names the commit of a copy without .git, as on a machine that is borrowed for a while."""


@functools.cache
def commit() -> str | None:
    """The git commit of this checkout, with "+changes" if tracked files differ from it; of a copy without .git what
    `VARIABLE` says, or None.

    Raises:
        VsfsimError: `VARIABLE` is not the name of a commit.
    """
    root = Path(vsfsim.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        said = os.environ.get(VARIABLE)
        if said is not None and not re.fullmatch(r"[0-9a-f]{40}(\+changes)?", said):
            raise VsfsimError(f"{VARIABLE} is '{said}', which is no commit. Give the 40 hexadecimal digits that `git "
                              f"rev-parse HEAD` prints where the copy was made, or unset it.")
        return said
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
