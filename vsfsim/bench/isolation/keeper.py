"""The process between the scorer and a method: it starts the sandbox, keeps what is printed, and ends every descendant.

It runs as a script of its own, without vsfsim and without the packages that are installed, in 20 ms. As a "subreaper"
(prctl(2)) it becomes the parent of whatever a method leaves behind, also of what has left its session, so that nothing
outlives it. `end_descendants` is what each trial's parent calls after the trial, too.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import json
import os
import select
import signal
import sys
import time
from pathlib import Path

_DEATH_SIGNAL, _DUMPABLE, _NO_NEW_PRIVILEGES, _BOUNDING_DROP, _SUBREAPER = 1, 4, 38, 24, 36
_KEPT = 1 << 0 | 1 << 1 | 1 << 3 | 1 << 4
"""Capabilities that root keeps: those to read and write files of others. All others go, so that it cannot attach to a
process that has them, such as the scorer."""


def prctl(option: int, value: int) -> None:
    """prctl(2); nothing happens on a system without it."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)


def adopt_orphans() -> None:
    """Become the parent of all descendants whose parent ends."""
    prctl(_SUBREAPER, 1)


def hide_memory() -> None:
    """Keep other processes of this user from attaching to this one, and from its files in /proc."""
    prctl(_DUMPABLE, 0)


def drop_privileges() -> None:
    """Lose, for good, what root may do beyond reading and writing files, and every way to gain privileges."""
    if sys.platform != "linux":
        return
    prctl(_NO_NEW_PRIVILEGES, 1)
    for capability in range(64):
        if not _KEPT >> capability & 1:
            prctl(_BOUNDING_DROP, capability)
    libc = ctypes.CDLL(None, use_errno=True)
    header, held = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    with contextlib.suppress(OSError, AttributeError):
        libc.capget(header, held)
        kept = [held[k] & (_KEPT if k < 3 else 0) for k in range(6)]
        libc.capset(header, (ctypes.c_uint32 * 6)(*kept))


def descendants(of: int) -> list[int]:
    """All living processes below a process, by /proc."""
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc") if os.path.isdir("/proc/self") else ():
        if name.isdigit():
            with contextlib.suppress(OSError, ValueError, IndexError):
                state, parent = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()[:2]
                if state not in "ZX":
                    children.setdefault(int(parent), []).append(int(name))
    found, waiting = [], [of]
    while waiting:
        below = children.get(waiting.pop(), [])
        found += below
        waiting += below
    return found


def end_descendants() -> None:
    """Kill all that runs below this process, and take note of their ends; new ones that appear meanwhile, too."""
    until = time.monotonic() + 20.0
    while time.monotonic() < until:
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return  # no child, and so no descendant: this process adopts them
        below = descendants(os.getpid())
        for number in (signal.SIGSTOP, signal.SIGKILL):  # what is stopped starts no other
            for pid in below:
                with contextlib.suppress(OSError):
                    os.kill(pid, number)
        if not below:
            return
        time.sleep(0.002)


def _end(*_: object) -> None:
    end_descendants()
    os._exit(143)


def main(text: str) -> None:
    """Run a command until it ends or this process is told to (SIGTERM), then end whatever is left of it.

    Args:
        text: JSON: ``words`` of the command; ``enter``, of `namespaces.enter`, or null; ``handles``, descriptors that
        the command inherits; ``log``, the file to which its output goes, and ``most``, the bytes it may hold. More
        ends the command.
    """
    given = json.loads(text)
    adopt_orphans()
    hide_memory()
    prctl(_DEATH_SIGNAL, signal.SIGTERM)
    signal.signal(signal.SIGTERM, _end)
    if os.getppid() == 1 != given["parent"]:
        return  # the scorer ended before this process knew
    read, write = os.pipe()
    command = os.fork()
    if command == 0:
        try:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.close(read)
            for handle in (1, 2):
                os.dup2(write, handle)
            prctl(_DEATH_SIGNAL, signal.SIGKILL)
            if given["enter"] is not None:
                _namespaces(given["namespaces"]).enter(given["enter"], drop_privileges)
            drop_privileges()
            os.execv(given["words"][0], given["words"])
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(127)
    for handle in [write, *given["handles"]]:
        os.close(handle)
    status = _keep(command, read, given["log"], given["most"])
    end_descendants()
    code = os.waitstatus_to_exitcode(status)
    if given["inside"] and code > 128:  # how a container says that it was ended by a signal
        code = 128 - code
    if code < 0:
        signal.signal(-code, signal.SIG_DFL) if -code not in (signal.SIGKILL, signal.SIGSTOP) else None
        os.kill(os.getpid(), -code)
        time.sleep(1.0)
    os._exit(max(code, 0))


def _keep(command: int, read: int, log: str, most: int) -> int:
    """Copy what is printed until the command has ended; returns its status."""
    with open(log, "ab", buffering=0) as file:
        watch = os.pidfd_open(command) if hasattr(os, "pidfd_open") else -1
        handles = [read, watch] if watch >= 0 else [read]
        while True:
            ready = select.select(handles, [], [], None if watch >= 0 else 0.05)[0]
            if read in ready:
                text = os.read(read, 1 << 16)
                left = max(most - file.tell(), 0)
                file.write(text[:left])
                if len(text) >= left:
                    end_descendants()
                    return 0
                if not text:
                    handles.remove(read)
            elif watch in ready or watch < 0:
                ended, status = os.waitpid(command, os.WNOHANG)
                if ended:
                    end_descendants()
                    os.set_blocking(read, False)
                    with contextlib.suppress(OSError):
                        file.write((os.read(read, 1 << 20) if read in handles else b"")[:max(most - file.tell(), 0)])
                    return status


def _namespaces(file: str):  # type: ignore[no-untyped-def]
    """The module beside this one; its package is not imported."""
    spec = importlib.util.spec_from_file_location("namespaces", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main(sys.argv[1])
