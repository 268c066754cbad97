"""The process that a method's processes are forked from, and the one that watches over each of them.

`main` imports what ships and what is installed, and nothing of the method's, so that a process of the method's starts
within milliseconds and finds no trace of another one. For each, the scorer sends one end of a line, one end of a second
line by which the process is ended, and the file for what is printed.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import glob
import importlib
import json
import os
import select
import shutil
import signal
import socket
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vsfsim.bench.isolation import box, child, limits

_DEATH_SIGNAL, _DUMPABLE, _SUBREAPER = 1, 4, 36


def main(words: list[str]) -> None:
    """Import, then fork a process for each request, until the scorer closes the line.

    Args:
        words: one JSON text: ``search``, the folders of ``sys.path``; ``control``, the descriptor of the line;
        ``warm``, names of modules; ``check``, operands of `_rehearse`, or null.
    """
    given = json.loads(words[0])
    prctl(_DUMPABLE, 0)  # no other process of this user reads its memory or attaches to it
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the ends of those that watch need no notice
    control = socket.socket(fileno=given["control"])
    line = Connection(os.dup(given["control"]))
    if given["check"] is not None:
        _rehearse(**given["check"])
    for name in given["warm"]:
        with contextlib.suppress(Exception, SystemExit):  # the method's own process says what is missing
            importlib.import_module(name)
    child.first_gradient()
    gc.freeze()
    with contextlib.suppress(EOFError, OSError):
        while True:
            request = json.loads(line.recv_bytes())
            _, handles, _, _ = socket.recv_fds(control, 1, 3)
            if os.fork() == 0:
                control.close()
                line.close()
                _watch(request, *handles)
            for handle in handles:
                os.close(handle)


def _rehearse(name: str, parameters: dict[str, Any]) -> None:
    """Test the contract of a method that ships: all that it loads is there for every process that is forked then."""
    from vsfsim.bench.check import check

    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # what PyTorch reads when it is imported; a fork has no other thread
    with contextlib.suppress(Exception, SystemExit):  # the method's own process says what is wrong
        check(name, parameters=parameters, brief=True)
    os.environ.update({} if before is None else {"OMP_NUM_THREADS": before})
    if before is None:
        del os.environ["OMP_NUM_THREADS"]


def prctl(option: int, value: int) -> None:
    """prctl(2); nothing happens on a system without it."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)


def _watch(given: dict[str, Any], line: int, end: int, log: int) -> None:
    """Fork the method's process, keep what it prints until it ends or is to end, end all that is left of it, and tell
    how it ended. Does not return.

    Args:
        given: ``box``, of `box.enter`, or null; ``folder``, for the working folder of a process without a container;
        ``memory``, of `limits.apply`; ``cache``, the folder of kernels that are compiled already;
        ``environment``, variables. line: of the method's process. end: closed to end it. log:
        file for what is printed.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    prctl(_SUBREAPER, 1)
    read, write = os.pipe()
    folder = tempfile.mkdtemp(dir=given["folder"])
    try:
        if given["box"] is not None:
            box.leave()
        process = os.fork()
        if process == 0:
            for number in (1, 2):
                os.dup2(write, number)
            os.dup2(line, 3)
            os.closerange(4, 1 << 16)
            _begin({**given, "folder": folder})
        os.close(line)
        os.close(write)
        status, usage, much = _keep(process, read, end, log, given["most"])
        said = {"code": os.waitstatus_to_exitcode(status), "much": much,
                "peak_mib": usage.ru_maxrss / (1024.0 if sys.platform == "linux" else 1024.0**2)}
    except OSError as error:
        said = {"code": 1, "much": False, "peak_mib": 0.0, "why": str(error)}
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        os.write(end, json.dumps(said).encode())
    os._exit(0)


def _begin(given: dict[str, Any]) -> None:
    """In the method's process. Does not return."""
    try:
        prctl(_DEATH_SIGNAL, signal.SIGKILL)  # it ends with the process that watches
        os.setsid()
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        if given["box"] is None:
            prctl(_DUMPABLE, 1)
            os.chdir(given["folder"])
        else:
            box.enter({**given["box"], "root": given["folder"]})
            os.close(0)
            os.open("/dev/null", os.O_RDONLY)  # in the container it is read-only; the one from outside keeps a time
        os.environ.update(given["environment"])
        child.private_caches(Path.cwd(), given["cache"])
        limits.apply(given["memory"], given["box"] is not None)
        importlib.invalidate_caches()
        child.main(Connection(3))
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(0)


def _keep(process: int, read: int, end: int, log: int, most: int) -> tuple[int, Any, bool]:
    """Copy what is printed until the process has ended or is to end; then end its descendants.

    Returns:
        The status of its end, what it used (`resource.struct_rusage`), and whether it printed more than ``most`` bytes.
    """
    watch = os.pidfd_open(process) if hasattr(os, "pidfd_open") else -1
    handles, much, ended = [read, end, *([watch] if watch >= 0 else [])], False, os.wait4(process, os.WNOHANG)
    while ended[0] == 0:
        ready = select.select(handles, [], [], None if watch >= 0 else 0.05)[0]
        if read in ready:
            text = os.read(read, 1 << 16)
            much = len(text) > _append(log, text, most)
            if not text:
                handles.remove(read)
        if end in ready or much:
            os.kill(process, signal.SIGKILL)
            handles = [h for h in handles if h not in (end, read)]
        if watch < 0 or watch in ready or end in ready or much:
            ended = os.wait4(process, 0 if end in ready or much else os.WNOHANG)
    end_descendants()
    os.set_blocking(read, False)
    with contextlib.suppress(OSError):
        while text := os.read(read, 1 << 16):
            _append(log, text, most)
    return ended[1], ended[2], much


def _append(log: int, text: bytes, most: int) -> int:
    return os.write(log, text[:max(most - os.fstat(log).st_size, 0)])


def end_descendants() -> None:
    """Kill all that runs below this process, which adopts whatever loses its parent, so that all are its own children
    in the end. In a container there is nothing left."""
    until = time.monotonic() + 20.0
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < until:
            for stat in glob.glob("/proc/[0-9]*/stat"):
                with contextlib.suppress(OSError):
                    if int(Path(stat).read_text().rpartition(")")[2].split()[1]) == os.getpid():
                        for number in (signal.SIGSTOP, signal.SIGKILL):  # what is stopped starts no other
                            os.kill(int(stat.split("/")[2]), number)
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
            time.sleep(0.002)


if __name__ == "__main__":
    main(sys.argv[1:])
