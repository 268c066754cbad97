"""The container of a method's process: namespaces of the kernel's own, entered by its system calls.

A process in it has files, processes, shared memory, users' names and network of its own (namespaces(7)). It sees the
system's libraries, Python, the installed packages, the method's source and what its parameters name, all of them
read-only, and one writable folder in memory, /tmp. When its first process ends, the kernel ends all others and forgets
everything that they wrote. Root becomes the user nobody; anyone else needs a user namespace.

This file runs as a script, too, to see whether a container works here. It imports nothing of vsfsim.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import struct
import sys
import tempfile
from typing import Any

_MOUNTS, _HOSTS, _IPC, _USER, _PIDS, _NET = 0x20000, 0x4000000, 0x8000000, 0x10000000, 0x20000000, 0x40000000
_BIND, _REC, _PRIVATE, _DETACH = 4096, 16384, 1 << 18, 2
_MOUNT_SETATTR, _RECURSIVE, _RDONLY, _NOSUID = 442, 0x8000, 1, 2
_DUMPABLE, _SECCOMP, _NO_NEW_PRIVILEGES = 4, 22, 38
_NOBODY = 65534
_CALLS = {"x86_64": (0xC000003E, 41, 53, 56, 272, 16, 72,
                     (248, 249, 250, 300, 327, 451, 206, 425, 103), (73, 221, 254)),
          "aarch64": (0xC00000B7, 198, 199, 220, 97, 29, 25,
                      (217, 218, 219, 262, 286, 451, 0, 425, 116), (32, 223, 27))}
# Of a machine, the number of its system calls' table, and in it socket, socketpair, clone, unshare, ioctl (of which
# nothing is asked of a file system, 0x66, which keeps keys and tells what of a file was read) and fcntl;
# what is refused: add_key, request_key, keyctl, fanotify_init, preadv2, cachestat, io_setup, io_uring_setup and syslog;
# what does nothing: flock, fadvise64 and inotify_add_watch. The kernel's keyrings are in no namespace of root's; its
# log, which keeps the name and address of what crashed, is in none, and neither are sockets to the host of a virtual
# machine, the algorithms that a socket of the cryptographic family leaves in the kernel, and the modules that the first
# socket of many a family loads. Locks, leases, hints and watches are of the file that all trials see, and so are its
# pages in memory, which advice drops and preadv2, cachestat and asynchronous reads tell. A ring makes calls that no
# filter sees. Whoever has users of his own may mount groups of processes, and load modules again.
_CLONE3, _UNIX, _X32 = 435, 1, 0x40000000
# clone3, whose flags no filter sees; the one family of sockets; the least number of a call of x86_64's second table.
_ON_FILES = (6, 7, 37, 38, 1024, 1026, 1036)
# Of fcntl: locks of a process and of an open file, set and waited for; a lease, a watch and the hint of a file.


def leave() -> None:
    """Leave the namespaces of this process; the next process that it forks is the first of the new ones.

    Raises:
        OSError: the system refuses.
    """
    uid, gid, libc = os.getuid(), os.getgid(), ctypes.CDLL(None, use_errno=True)
    own = _HOSTS | _IPC | _PIDS | _NET
    if uid != 0 or libc.unshare(own) != 0:
        _check(libc.unshare(own | _USER), "unshare")
        for file, text in (("setgroups", "deny"), ("uid_map", f"{uid} {uid} 1"), ("gid_map", f"{gid} {gid} 1")):
            with open(f"/proc/self/{file}", "w") as out:
                out.write(text)


def enter(given: dict[str, Any]) -> None:
    """In that first process: see only what is given, work in /tmp/work, and lose every privilege.

    Args:
        given: ``root``, an empty folder; ``shown``, files and folders by absolute path; ``links``, pairs of a path and
        what it points to; ``emptied``, folders of which is seen only what is shown in them; ``hidden``, folders that
        appear empty, and pipes, in whose place is /dev/null; ``size``, the most bytes in /tmp, where the number of
        files is limited, too, as each takes a kilobyte of the kernel's.

    Raises:
        OSError: the system refuses; the message says which step.
    """
    root, libc = given["root"], ctypes.CDLL(None, use_errno=True)
    os.umask(0o022)
    _check(libc.unshare(_MOUNTS), "unshare")
    _mount(None, "/", None, _REC | _PRIVATE)
    _mount("tmpfs", root, "tmpfs", 0, "mode=755")
    for name in ("proc", "tmp", "dev", "dev/shm"):
        os.mkdir(f"{root}/{name}")
    _mount("tmpfs", f"{root}/tmp", "tmpfs", _NOSUID, f"size={given['size']},nr_inodes=99k")
    _mount("proc", f"{root}/proc", "proc", _NOSUID)
    for path, target in (*given["links"], ("/dev/fd", "/proc/self/fd"), ("/dev/stdin", "/proc/self/fd/0"),
                         ("/dev/stdout", "/proc/self/fd/1"), ("/dev/stderr", "/proc/self/fd/2")):
        os.makedirs(os.path.dirname(root + path), exist_ok=True)
        os.symlink(target, root + path)
    for path in (*sorted({*given["shown"], *given["emptied"]}), *given["hidden"]):
        if path not in (*given["emptied"], *given["hidden"]):
            with contextlib.suppress(FileExistsError):  # it lies in a folder that is shown
                _show(path, root + path)
        elif os.path.isdir(root + path):
            _mount("tmpfs", root + path, "tmpfs", 0, "mode=755,size=64k")
        elif os.path.exists(root + path):
            _mount("/dev/null", root + path, None, _BIND)
    _set(root, _RDONLY, 0, _RECURSIVE)
    _set(f"{root}/tmp", 0, _RDONLY)
    for name in ("shm", "work"):
        os.mkdir(f"{root}/tmp/{name}")
        os.chmod(f"{root}/tmp/{name}", 0o1777)
    _mount(f"{root}/tmp/shm", f"{root}/dev/shm", None, _BIND)
    os.chdir(root)
    _check(libc.pivot_root(b".", b"."), "pivot_root")
    _check(libc.umount2(b".", _DETACH), "umount")
    os.chdir("/tmp/work")
    _lose_privileges(libc)


def _show(path: str, target: str) -> None:
    """Bind a file or folder into the new root; of a folder that only its owner reads, as `mktemp -d` makes, each entry,
    for root is nobody in the container.

    Raises:
        FileExistsError: it is there already.
    """
    if os.path.isdir(path):
        if os.path.isdir(target) and os.listdir(target):
            raise FileExistsError(target)
        os.makedirs(target, exist_ok=True)
        if os.stat(path).st_mode & 0o005 != 0o005:
            for name in filter(lambda name: os.path.exists(f"{path}/{name}"), os.listdir(path)):
                _show(f"{path}/{name}", f"{target}/{name}")
            return
    else:
        os.makedirs(os.path.dirname(target), exist_ok=True)
        os.close(os.open(target, os.O_CREAT | os.O_EXCL))
    _mount(path, target, None, _BIND | _REC)


def _lose_privileges(libc: ctypes.CDLL) -> None:
    """For good: no capability, no way to gain one, no keyring."""
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if os.getuid() == 0:
        with contextlib.suppress(OSError):  # a user namespace of one user knows no other
            os.setgroups([])
            os.setresgid(_NOBODY, _NOBODY, _NOBODY)
            os.setresuid(_NOBODY, _NOBODY, _NOBODY)
            libc.prctl(_DUMPABLE, 1, 0, 0, 0)
    _check(libc.capset((ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()), "capset")
    if calls := _CALLS.get(platform.machine()):
        table, socket, pair, clone, unshare, asked, control, refused, shared = calls
        load, equal, at_least, has, mask = 0x20, 0x15, 0x35, 0x45, 0x54
        # see seccomp(2): the table's number, the call's, the family of a socket, flags, what fcntl is asked
        rules = [(load, 4), (equal, table, 0, "refuse"), (load, 0), (at_least, _X32, "refuse", 0),
                 *((equal, call, "refuse", 0) for call in refused),
                 *((equal, call, "ignore", 0) for call in shared), (equal, _CLONE3, "unknown", 0),
                 (equal, socket, 1, 0), (equal, pair, 0, 2), (load, 16), (equal, _UNIX, "allow", "refuse"),
                 (equal, clone, 1, 0), (equal, unshare, 0, 2), (load, 16), (has, _USER, "refuse", "allow"),
                 (equal, asked, 0, 3), (load, 24), (mask, 0xFF00),
                 (equal, 0x6600, "refuse", "allow"), (equal, control, 0, "allow"), (load, 24),
                 *((equal, what, "ignore", 0) for what in _ON_FILES)]
        # ends: allow, refuse with EPERM, say that it was done, or that there is no such call, so that libraries make
        # another (ENOSYS); a jump counts the steps that it leaves out
        ends = {"allow": 0x7FFF0000, "refuse": 0x50001, "ignore": 0x50000, "unknown": 0x50026}
        place = {name: len(rules) + k for k, name in enumerate(ends)}
        steps = [(code, *(place[to] - k - 1 if to in place else to for to in jumps or (0, 0)),
                  value) for k, (code, value, *jumps) in enumerate(rules)]
        steps += [(0x06, 0, 0, value) for value in ends.values()]
        words = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *step) for step in steps))
        program = (ctypes.c_uint64 * 2)(len(steps), ctypes.addressof(words))
        _check(libc.prctl(_SECCOMP, 2, program, 0, 0), "seccomp")


def _set(path: str, on: int, off: int, flags: int = 0) -> None:
    """Change the attributes of a mount, see mount_setattr(2)."""
    attributes = (ctypes.c_uint64 * 4)(on, off, 0, 0)
    _check(ctypes.CDLL(None, use_errno=True).syscall(
        ctypes.c_long(_MOUNT_SETATTR), ctypes.c_long(-100), os.fsencode(path),
        ctypes.c_ulong(flags), attributes, ctypes.c_ulong(32)), f"mount_setattr of {path}")


def _mount(source: str | None, target: str, kind: str | None, flags: int, data: str | None = None) -> None:
    words = [None if text is None else os.fsencode(text) for text in (source, target, kind, data)]
    libc = ctypes.CDLL(None, use_errno=True)
    _check(libc.mount(words[0], words[1], words[2], ctypes.c_ulong(flags), words[3]), f"mount of {target}")


def _check(code: int, what: str) -> None:
    if code != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")


def main() -> int:
    """Whether a container works here: 0 if it does."""
    with tempfile.TemporaryDirectory() as root:
        leave()
        if os.fork() == 0:
            try:
                enter({"root": root, "shown": ["/usr"], "links": [], "emptied": [], "hidden": [], "size": "1m"})
                os._exit(0 if os.getpid() == 1 and os.path.isdir("/proc/self") else 1)
            finally:
                os._exit(1)
        return os.waitstatus_to_exitcode(os.wait()[1])


if __name__ == "__main__":
    sys.exit(main())
