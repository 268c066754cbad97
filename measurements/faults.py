"""Faults that making a dataset survives: each is caused on purpose, and the same command must then give the same bytes.

A small scene of two blocks is made undisturbed, and again under each fault. A fault is survived if the disturbed run
ends as it should, leaves no half-written file behind, and the same command run again gives the undisturbed bytes.
"""

from __future__ import annotations

import contextlib
import glob
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measurements.measurement import Progress
from vsfsim.core.errors import DatasetError
from vsfsim.core.text_table import text_table
from vsfsim.generate.workers import largest

GRACE = 30.0
"""Within which a run that gets SIGTERM must have ended [s]; what a scheduler gives."""
_LIMIT = 300.0  # of one run [s]
_SCENE = """
name = "faults"
[object]
shape = { box = [0.06, 0.06, 0.03] }
resolution = 0.02
poisson_ratio = 0.4
young_modulus = { loguniform = [2e4, 2e5] }
[probe]
shape = { sphere = 0.01 }
[touches]
count = 1
depth = 0.004
approach = 0.005
frames = { free = 1, in = 2, hold = 0, out = 1 }
[camera]
width = 64
height = 48
distance = 0.25
[dataset]
objects = 2
views = 1
splits = { train = 1, test = 1 }
"""
_CLOCK = """
import sys, time
real, jumps = time.time, iter(range(10**9))
time.time = lambda: real() + (-1) ** next(jumps) * 86400.0 * 400
from vsfsim.cli.main import main
sys.argv = ["vsfsim", *sys.argv[1:]]
main()
"""


@dataclass(frozen=True)
class Run:
    """A run of `vsfsim generate` that something may happen to."""

    folder: Path
    """With the scene, and the dataset in ``d``."""
    process: subprocess.Popen[str]
    """The command."""

    def until(self, ready: Callable[[], bool]) -> None:
        """Wait for something, or for the end."""
        end = time.monotonic() + _LIMIT
        while self.process.poll() is None and not ready() and time.monotonic() < end:
            time.sleep(0.005)

    def end(self) -> tuple[int, str]:
        """Exit code and what was said on stderr."""
        said = self.process.communicate(timeout=_LIMIT)[1]
        return self.process.returncode, said


def measure(*, kills: int = 3, seed: int = 0, progress: Progress = lambda _: None) -> list[dict[str, Any]]:
    """A row for every fault.

    Args:
        kills: of a run at random moments, and of one of its workers. seed: of the moments. progress: told each fault.

    Returns:
        fault, what happened, and whether it was survived.
    """
    rows = []
    with tempfile.TemporaryDirectory() as place:
        root, rng = Path(place), random.Random(seed)
        (root / "faults.toml").write_text(_SCENE)
        progress("undisturbed")
        began = time.monotonic()
        code, said = start(root / "whole").end()
        if code:
            raise DatasetError(f"the undisturbed run failed: {said}")
        length, whole = time.monotonic() - began, contents(root / "whole" / "d")
        for name, fault in (("the run is killed (-9)", _killed), ("a worker is killed (-9)", _worker_killed),
                            ("SIGTERM", _terminated), ("the disk is full", _full), ("a read-only place", _read_only),
                            ("a second writer", _two_writers), ("the clock jumps by 400 days", _clock)):
            for _ in range(kills if "-9" in name else 1):
                progress(name)
                folder = root / f"{len(rows)}"
                words, ended = fault(folder, rng.uniform(0.3, 1.0) * length)
                code, said = start(folder).end()
                same = code == 0 and contents(folder / "d") == whole
                rows.append({"fault": name, "found": words + (f"; then {said.strip()[-200:]}" if code else ""),
                             "survived": bool(ended and same)})
    progress("the GPU's memory runs out")
    rows.append(_short_of_memory())
    return rows


def text(rows: Sequence[dict[str, Any]]) -> str:
    """The table."""
    return text_table(("fault", "what happened", "survived"),
                      [(r["fault"], r["found"], "yes" if r["survived"] else "NO") for r in rows])


def start(folder: Path, *, before: Callable[[], None] | None = None, script: str = "",
          out: Path | None = None) -> Run:
    """Begin to make the dataset ``folder``/d, in a session of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    head = [sys.executable, "-c", script] if script else [sys.executable, "-m", "vsfsim"]
    words = [*head, "generate", str(folder.parent / "faults.toml"), "--out", str(out or folder / "d"), "--workers", "2"]
    return Run(folder, subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                                        start_new_session=True, preexec_fn=before))


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()} if folder.is_dir() else {}


def _kept(folder: Path) -> str:
    return f"{len(list((folder / 'd').glob('*.h5')))} of 2 views kept"


def _killed(folder: Path, moment: float) -> tuple[str, bool]:
    run, end = start(folder), time.monotonic() + moment
    run.until(lambda: time.monotonic() > end)
    os.killpg(run.process.pid, signal.SIGKILL)
    run.end()
    return f"after {moment:.1f} s; {_kept(folder)}", True


def _worker_killed(folder: Path, moment: float) -> tuple[str, bool]:
    run, end = start(folder), time.monotonic() + moment
    run.until(lambda: time.monotonic() > end)
    children = descendants(run.process.pid)
    if children:
        os.kill(children[-1], signal.SIGKILL)
    code, said = run.end()
    ended = code == 0 or (code == 2 and "Run the same command again" in said)
    return f"after {moment:.1f} s; exit code {code}, {_kept(folder)}", ended or not children


def _terminated(folder: Path, moment: float) -> tuple[str, bool]:
    run = start(folder)
    run.until(lambda: bool(list((folder / "d").glob("*.h5"))))
    began = time.monotonic()
    run.process.send_signal(signal.SIGTERM)
    code, _ = run.end()
    took = time.monotonic() - began
    clean = not list((folder / "d").glob("*.part"))
    return f"ended in {took:.1f} s, exit code {code}, {_kept(folder)}", code in (0, 143) and took < GRACE and clean


def _full(folder: Path, moment: float) -> tuple[str, bool]:
    run = start(folder, before=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)))
    code, said = run.end()
    told = code == 2 and "Traceback" not in said and "cannot be written" in said
    return f"exit code {code}, {'told' if told else said.strip()[-80:]}, {_kept(folder)}", told


def _read_only(folder: Path, moment: float) -> tuple[str, bool]:
    code, said = start(folder, out=Path("/sys/vsfsim-faults")).end()
    told = code == 2 and "Traceback" not in said and "Choose another --out" in said
    return f"exit code {code}, {'told' if told else said.strip()[-80:]}", told


def _two_writers(folder: Path, moment: float) -> tuple[str, bool]:
    first = start(folder)
    first.until(lambda: (folder / "d" / "dataset.part.json").exists())
    second = start(folder)
    code, said = second.end()
    refused = code == 2 and "is being written by process" in said
    finished, _ = first.end()
    return (f"the second {'is refused' if refused else f'ends with code {code}'}, the first ends with code {finished}",
            finished == 0 and (refused or code == 0))


def _clock(folder: Path, moment: float) -> tuple[str, bool]:
    code, _ = start(folder, script=_CLOCK).end()
    return f"exit code {code}, {_kept(folder)}", code == 0


def _short_of_memory() -> dict[str, Any]:
    """A device that is simulated: it holds so many touches, and refuses more as Warp does."""
    asked: list[int] = []

    def device(room: int) -> Callable[[int], int]:
        def make(size: int) -> int:
            asked.append(size)
            if size > room:
                raise RuntimeError(f"Failed to allocate {size} bytes on device 'cuda:0' (CUDA error 2: out of memory)")
            return size

        return make

    fits = largest(device(300), 4096, 17, "plants", "cuda:0")
    try:
        largest(device(3), 4096, 17, "plants", "cuda:0")
        told = ""
    except DatasetError as error:
        told = str(error)
    return {"fault": "the GPU's memory runs out (simulated)",
            "found": f"{asked[0]} touches at once, then {fits}; where not even 17 fit, an error that names what to do",
            "survived": fits == 256 and "--touches" in told}


def descendants(process: int) -> list[int]:
    """Processes that a process and its children have started, children first (Linux)."""
    out, todo = [], [process]
    while todo:
        here = todo.pop(0)
        found: list[int] = []
        for path in glob.glob(f"/proc/{here}/task/*/children"):  # empty if the process has ended, where Path's raises
            with contextlib.suppress(OSError):
                found += [int(word) for word in Path(path).read_text().split()]
        out += found
        todo += found
    return out
