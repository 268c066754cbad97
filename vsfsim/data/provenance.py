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
from vsfsim.core.system.content import files_sha256

VARIABLE = "VSFSIM_COMMIT"
"""Environment variable that says, of a copy without .git, COMMIT@SHA256: its commit, and the digest of that commit's
code. `python -m vsfsim.data.provenance` prints both in a checkout."""
_CODE = ("vsfsim", "scenes", "baselines", "tasks")


@functools.cache
def commit() -> str | None:
    """The git commit of this checkout, with "+changes" if tracked files differ from it. Of a copy without .git what
    `VARIABLE` says, with "+changes" if the code here has not the digest that it names; None if it says nothing.

    Raises:
        VsfsimError: `VARIABLE` is not a commit and a digest.
    """
    root = Path(vsfsim.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        said = os.environ.get(VARIABLE) or None  # an image that was built without its commit has it empty
        if said is not None and not re.fullmatch(r"[0-9a-f]{40}@[0-9a-f]{64}", said):
            raise VsfsimError(f"{VARIABLE} is '{said}', which is no commit and digest. Give what `python -m "
                              f"vsfsim.data.provenance` prints where the copy was made, or unset it.")
        return None if said is None else said[:40] + ("" if said[41:] == code_sha256(root) else "+changes")
    try:
        head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10,
                              check=True).stdout.strip()
        changes = subprocess.run(["git", "-C", str(root), "status", "--porcelain", "--untracked-files=no", "--",
                                  *_CODE],
                                 capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+changes" if changes else "")


def code_sha256(root: Path) -> str:
    """sha256 of the names and contents of the .py, .toml and .xml files of a checkout's code or an installed copy."""
    places = {name: path for name in _CODE for path in (root / name, root / "vsfsim" / name) if path.is_dir()}
    files = {f"{name}/{path.relative_to(folder)}": path for name, folder in places.items()
             for path in folder.rglob("*") if path.suffix in (".py", ".toml", ".xml")
             and (name != "vsfsim" or path.relative_to(folder).parts[0] not in (*_CODE, "leaderboard"))}
    return files_sha256(files)


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


if __name__ == "__main__":
    print(f"{commit()}@{code_sha256(Path(vsfsim.__file__).resolve().parent.parent)}")
