"""A container of Linux namespaces, made by the system calls themselves where bubblewrap is not installed.

Files, processes, network and shared memory of the method's are its own (unshare(2)). Root needs no user namespace for
that. Like `keeper`, this file runs without its package.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from typing import Any

_MOUNTS, _HOSTS, _IPC, _USER, _PIDS, _NET = 0x20000, 0x4000000, 0x8000000, 0x10000000, 0x20000000, 0x40000000
_RDONLY, _NOSUID, _NODEV, _NOEXEC, _REMOUNT, _BIND, _MOVE, _REC, _PRIVATE = (
    1, 2, 4, 8, 32, 4096, 8192, 16384, 1 << 18)
_LOCKED = {2: 2, 4: 4, 8: 8, 1024: 1024, 2048: 2048, 4096: 1 << 21}
"""Flags of statvfs(3) that a remount must repeat, and those of mount(2)."""


def enter(given: dict[str, Any], drop_privileges: Callable[[], None]) -> None:
    """Go into new namespaces; returns in a process that is not their first.

    Args:
        given: ``root``, an empty folder; ``shown``, pairs of an absolute path and whether it may be written;
        ``links``, pairs of a path and what it points to; ``hidden``, folders that appear empty; ``folder``, where to
        work.
        drop_privileges: called before anything of the method's runs.

    Raises:
        OSError: the system refuses; the message says which step.
    """
    uid, gid = os.getuid(), os.getgid()
    libc = ctypes.CDLL(None, use_errno=True)
    own = _MOUNTS | _HOSTS | _IPC | _PIDS | _NET
    if uid != 0 or libc.unshare(own) != 0:
        _check(libc.unshare(own | _USER), "unshare")
        for file, text in (("setgroups", "deny"), ("uid_map", f"{uid} {uid} 1"), ("gid_map", f"{gid} {gid} 1")):
            with open(f"/proc/self/{file}", "w") as out:
                out.write(text)
    root = given["root"]
    _mount(None, "/", None, _REC | _PRIVATE)
    _mount("tmpfs", root, "tmpfs", _NOSUID | _NODEV, "mode=755")
    for name in ("proc", "tmp", "dev", "dev/shm"):
        os.mkdir(f"{root}/{name}")
        os.chmod(f"{root}/{name}", 0o1777 if name in ("tmp", "dev/shm") else 0o755)
    for path, target in given["links"]:
        os.makedirs(os.path.dirname(root + path), exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.symlink(target, root + path)
    for path, target in (("fd", "/proc/self/fd"), ("stdin", "fd/0"), ("stdout", "fd/1"), ("stderr", "fd/2")):
        os.symlink(target, f"{root}/dev/{path}")
    for path, writable in given["shown"]:
        _show(path, root + path, bool(writable))
    for path in given["hidden"]:
        if os.path.isdir(root + path):
            _mount("tmpfs", root + path, "tmpfs", _NOSUID | _NODEV, "mode=755,size=64k")
    _follow(os.fork())
    libc.prctl(1, signal.SIGKILL, 0, 0, 0)  # the first process of the namespace ends with the one outside
    _mount("proc", f"{root}/proc", "proc", _NOSUID | _NODEV | _NOEXEC)
    os.chdir(root)
    _mount(root, "/", None, _MOVE)
    os.chroot(".")
    os.chdir(given["folder"])
    drop_privileges()
    _follow(os.fork())


def _follow(child: int) -> None:
    """In a parent: end as the child does, having taken note of all other ends. Returns in the child only."""
    if child == 0:
        return
    with contextlib.suppress(OSError):
        os.closerange(3, 4096)
    while True:
        ended, status = os.wait()
        if ended == child:
            code = os.waitstatus_to_exitcode(status)
            os._exit(code if code >= 0 else 128 - code)


def _show(path: str, target: str, writable: bool) -> None:
    """Bind a file or folder into the new root."""
    if os.path.isdir(path):
        os.makedirs(target, exist_ok=True)
    else:
        os.makedirs(os.path.dirname(target), exist_ok=True)
        if not os.path.exists(target):
            with open(target, "w"):
                pass
    _mount(path, target, None, _BIND | _REC)
    if writable:
        return
    with open("/proc/self/mountinfo") as file:
        inner = [line.split()[4].replace("\\040", " ") for line in file]
    for place in sorted({target, *(p for p in inner if p.startswith(target + "/"))}):
        with contextlib.suppress(OSError) if place != target else contextlib.nullcontext():
            flags = os.statvfs(place).f_flag
            kept = sum(flag for bit, flag in _LOCKED.items() if flags & bit)
            _mount(None, place, None, _BIND | _REMOUNT | _RDONLY | kept)


def _mount(source: str | None, target: str, kind: str | None, flags: int, data: str | None = None) -> None:
    words = [None if text is None else text.encode() for text in (source, target, kind, data)]
    libc = ctypes.CDLL(None, use_errno=True)
    _check(libc.mount(words[0], words[1], words[2], ctypes.c_ulong(flags), words[3]), f"mount of {target}")


def _check(code: int, what: str) -> None:
    if code != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")


if __name__ == "__main__":  # whether it works here: exit code 0
    with tempfile.TemporaryDirectory() as root:
        if os.fork() == 0:
            try:
                enter({"root": root, "shown": [["/usr", False]], "links": [], "hidden": [], "folder": "/"},
                      lambda: None)
                os._exit(0 if os.getpid() != 1 and os.path.isdir("/proc/self") else 1)
            except BaseException as error:
                print(json.dumps(str(error)), file=sys.stderr)
            finally:
                os._exit(1)
        code = os.waitstatus_to_exitcode(os.wait()[1])
    sys.exit(code)
