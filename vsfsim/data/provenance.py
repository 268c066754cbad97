"""Which code made a file, and on what kind of machine."""

from __future__ import annotations

import functools
import os
import platform
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
        said = os.environ.get(VARIABLE) or None  # an image that was built without its commit has it empty
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


@functools.cache
def processor() -> str:
    """The kind of this machine's CPU: its name, and what decides how it rounds, which is the widest instruction set
    and what the environment forbids of it."""
    fields: dict[str, str] = {}
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            key, _, value = line.partition(":")
            fields.setdefault(key.strip(), value.strip())
    except OSError:
        return platform.processor() or platform.machine()
    flags = fields.get("flags", "").split()
    widest = next((name for name in ("avx512f", "avx2", "avx", "sse4_2") if name in flags), platform.machine())
    asked = [f"{name}={os.environ[name]}" for name in _ROUNDING if name in os.environ]
    number = f"{fields.get('cpu family', '?')}-{fields.get('model', '?')}"
    return ", ".join([fields.get("model name", platform.machine()), f"family {number}", widest, *asked])


_ROUNDING = ("ATEN_CPU_CAPABILITY", "MKL_CBWR", "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
"""Variables by which libraries choose other instructions than the widest."""


def machine_kind(accelerator: str = "") -> str:
    """The kind of machine that a file was made on.

    Args:
        accelerator: name of the GPU that took part, "" for none.
    """
    return "; ".join(filter(None, [accelerator, processor()]))
