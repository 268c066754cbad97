"""A method that leaves a note in every place that it knows, in each training and each trial, and looks for one there.

It prints "found WAY" for a note that is there, and answers 0 in place of 1.5 if there is one. Each way is a function
that is given "leave" or "take" and returns whether a note was there, or what it says. A note of a training in its
caches is a part of what it learned, and no find for its trials.
"""

import ctypes
import glob
import os
import signal
import socket
import sys
import time
from multiprocessing import shared_memory

from toy_methods import Constant

import vsfsim

NOTE = "vsfsim-note"
LIBC = ctypes.CDLL(None, use_errno=True)
KEY = 0x5653


def file(folder):
    def way(do):
        path = os.path.join(folder(), NOTE)
        if do == "take":
            return open(path).read()
        os.makedirs(folder(), exist_ok=True)
        with open(path, "w") as note:
            note.write(Leaks.where)

    return way


def posix_memory(do):
    if do == "take":
        shared_memory.SharedMemory(NOTE).close()
        return True
    memory = shared_memory.SharedMemory(NOTE, create=True, size=16)
    memory.close()


def systemv(call, *operands):
    return lambda do: getattr(LIBC, call)(KEY, *operands, 0o1666 if do == "leave" else 0o666) >= 0


def posix_queue(do):
    library = ctypes.CDLL("librt.so.1", use_errno=True)
    return library.mq_open(f"/{NOTE}".encode(), os.O_RDWR | (os.O_CREAT if do == "leave" else 0), 0o666, None) >= 0


def keyring(ring, table=0):
    def way(do):
        calls = [k + table for k in {"x86_64": (248, 250), "aarch64": (217, 219)}[os.uname().machine]]
        if do == "leave":
            return LIBC.syscall(calls[0], b"user", NOTE.encode(), b"x", 1, ring) >= 0
        return LIBC.syscall(calls[1], 10, ring, b"user", NOTE.encode(), 0) >= 0  # KEYCTL_SEARCH

    return way


def daemon(do):
    """A process that outlives its parent and has left its session, and listens."""
    with socket.socket(socket.AF_UNIX) as line:
        if do == "take":
            line.connect(f"\0{NOTE}")
            return True
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            with socket.socket(socket.AF_UNIX) as line:
                line.bind(f"\0{NOTE}")
                line.listen()
                time.sleep(20.0)
        os._exit(0)
    os.wait()
    time.sleep(0.1)


def attribute(of):
    def way(do):
        found, of.note = hasattr(of, "note"), True
        return found

    return way


def descriptors(do):
    """Anything but the standard ones and the line to the scorer, which could be another trial's, too."""
    return do == "take" and any(int(name) > 3 and "/proc/" not in os.readlink(f"/proc/self/fd/{name}")
                                for name in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{name}"))


def file_system(do):
    """What a file system says of a file beyond its text: the flags that FS_IOC_GETFLAGS gets."""
    with open(os.__file__) as source:
        return LIBC.ioctl(source.fileno(), 0x80086601, bytes(8)) == 0


def printed(do):
    """What other trials printed, by opening the standard output to read it."""
    if do == "leave":
        return print(NOTE, "printed", flush=True)
    handle = os.open("/proc/self/fd/1", os.O_RDONLY | os.O_NONBLOCK)
    return NOTE.encode() in os.read(handle, 1 << 20)


def other_processes(do):
    """A process of somebody else's, seen, signalled or attached to."""
    others = [int(name) for name in os.listdir("/proc") if name.isdigit() and int(name) not in (1, os.getpid())]
    mine = [pid for pid in others if open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[1] in (
        "1", str(os.getpid()))]
    return do == "take" and (bool(set(others) - set(mine)) or (os.getppid() != 0 and LIBC.ptrace(
        0x4206, os.getppid(), 0, 0) == 0))


def system_settings(do):
    """Settings that root may write by its number alone."""
    for path in ("/proc/sys/kernel/core_pattern", "/proc/sysrq-trigger", "/proc/sys/vm/swappiness"):
        with open(path, "a"):
            return do == "take"


def kernels(do):
    """Compiled kernels of the user's, replaced through the links to them, or by others of their names."""
    import warp  # noqa: F401  (whoever uses it finds the user's kernels)

    found = ""
    for path in glob.glob(os.path.join(os.environ.get("WARP_CACHE_PATH", ""), "**", "*.o"), recursive=True):
        content = open(path, "rb").read()
        found = found or (content.decode() if len(content) < 10 else "")
        if do == "leave":
            try:
                open(path, "wb").write(Leaks.where.encode())
            except OSError:
                os.remove(path)
                open(path, "wb").write(Leaks.where.encode())
    return found


def every_mount(do):
    """A file in the root of everything that is mounted."""
    places = [line.split()[4] for line in open("/proc/self/mountinfo")]
    if do == "take":
        return any(os.path.exists(os.path.join(place, NOTE)) for place in places)
    for place in places:
        try:
            open(os.path.join(place, NOTE), "w").close()
        except OSError:
            continue


def page_cache(missing, first=0):
    """Two of every four pages of a file that all see are in memory, of 16; ``missing`` is larger for the others. A disk
    that reads several pages at once makes one of two neighbours quick, so that nearly all must be as they should."""
    def way(do):
        with open(os.path.join(os.path.dirname(os.__file__), "pydoc_data", "topics.py"), "rb") as file:
            handle, places = file.fileno(), range(first, first + (1 << 18), 1 << 14)
            os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_RANDOM)
            if do == "take":
                found = [missing(handle, place) for place in places]
                inside, outside = (sorted(found[k::4] + found[k + 1::4]) for k in (0, 2))
                return outside[2] > 5.0 * inside[-3]
            os.posix_fadvise(handle, first, 1 << 18, os.POSIX_FADV_DONTNEED)
            return [os.pread(handle, 1, place) for k in (0, 1) for place in places[k::4]] and None

    return way


def wait(handle, place):
    start = time.perf_counter()
    return os.pread(handle, 1, place) and time.perf_counter() - start


def absent(handle, place):
    try:
        return os.preadv(handle, [bytearray(1)], place, os.RWF_NOWAIT) - 1
    except BlockingIOError:
        return 1


WAYS = {
    "page cache": page_cache(absent), "page cache by the clock": page_cache(wait, 1 << 18),
    "watch": lambda do: LIBC.syscall(262 + 38 * (os.uname().machine == "x86_64"), 0x200, 0) >= 0 and do == "take",
    "file system": file_system,
    "ring of calls": lambda do: LIBC.syscall(425, 8, bytes(120)) >= 0 and do == "take",
    "working folder": file(os.getcwd), "/tmp": file(lambda: "/tmp"), "/var/tmp": file(lambda: "/var/tmp"),
    "/dev/shm": file(lambda: "/dev/shm"), "home": file(lambda: os.path.expanduser("~/.config")),
    "Warp's cache": file(lambda: os.environ.get("WARP_CACHE_PATH", os.path.expanduser("~/.cache/warp"))),
    "torch's cache": file(lambda: os.path.join(os.environ.get("TORCH_HOME", "/tmp/torch"), "hub")),
    "XDG's cache": file(lambda: os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))),
    "the package": file(lambda: vsfsim.__path__[0]),
    "the package's bytecode": file(lambda: os.path.join(vsfsim.__path__[0], "__pycache__")),
    "own folder": file(lambda: os.path.dirname(__file__)), "Python": file(lambda: sys.prefix),
    "every mount": every_mount, "kernels": kernels, "POSIX memory": posix_memory,
    "System V memory": systemv("shmget", 16), "System V queue": systemv("msgget"), "POSIX queue": posix_queue,
    "user's keyring": keyring(-4), "session's keyring": keyring(-3), "x32's keyring": keyring(-3, 1 << 30),
    "abstract socket": daemon, "class attribute": attribute(Constant),
    "users of its own": lambda do: LIBC.unshare(1 << 28) == 0 and do == "take", "imported module": attribute(socket),
    "descriptors": descriptors, "printed": printed, "system settings": system_settings,
    "other processes": other_processes,
    "input's time": lambda do: os.utime("/proc/self/fd/0") is None and do == "take",
    "socket to the kernel": lambda do: socket.socket(socket.AF_NETLINK).fileno() and do == "take",
}


class Leaks(Constant):
    """Tries ``ways``, names of `WAYS` with commas between them; "" for all."""

    where = ""

    def __init__(self, *, seed=0, ways=""):
        super().__init__()
        self.ways = ways.split(",") if ways else list(WAYS)

    def meta_fit(self, specimens):
        self.pass_notes("training")

    def adapt(self, view, support):
        super().adapt(view, support)
        self.pass_notes("trial")

    def pass_notes(self, where):
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        Leaks.where = where
        for do in ("take", "leave"):
            for name in self.ways:
                try:
                    found = WAYS[name](do)
                except Exception as error:  # a way that is barred
                    print(where, do, name, type(error).__name__, flush=True)
                    continue
                if do == "take" and found and not (found == "training" and where == "trial"):
                    self.value = 0.0
                    print("found", name, flush=True)
        print("looked in", where, flush=True)
