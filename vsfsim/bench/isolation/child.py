"""A method's processes: the one that the others are forked from, the one that watches over each of them, and each.

`main` imports what ships and what is installed, and nothing of the method's, so that a process of the method's starts
within milliseconds and finds no trace of another one. For each, the scorer sends one end of a line, one end of a second
line by which the process is ended, and the file for what is printed. The process goes into its container and answers
requests (`_answer`): it looks at the method, lets it learn, or makes a trial. What the method learned leaves it as
bytes (the pickled method, and what it put into its caches), and each trial begins with these bytes and with nothing
else.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import inspect
import json
import os
import pickle
import select
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench import method as rules
from vsfsim.bench.isolation import box, limits
from vsfsim.bench.isolation.wire import Reply, encoded, packed
from vsfsim.core.errors import MethodError, VsfsimError
from vsfsim.core.extras import MissingPackage
from vsfsim.core.plain_text import plain
from vsfsim.core.system.engines import one_thread

_DEATH_SIGNAL, _DUMPABLE, _SUBREAPER = 1, 4, 36
OPTIONAL = ("stiffness", "locate", "choose")
"""Functions of a method that the scorer asks for where they exist."""


def main(given: dict[str, Any]) -> None:
    """Import, then fork a process for each request, until the scorer closes the line.

    Args:
        given: ``control``, the descriptor of the line; ``warm``, names of modules; ``check``, operands of `_rehearse`,
        or null; and, of every process, ``box``, of `box.enter`, or null; ``folder``, for the working folder of one
        without a container; ``memory``, of `limits.apply`; ``cache``, the folder of kernels that are compiled already;
        ``most``, bytes that all may print.
    """
    prctl(_DUMPABLE, 0)  # no other process of this user reads its memory or attaches to it
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the ends of those that watch need no notice
    control = socket.socket(fileno=given["control"])
    if given["check"] is not None:
        _rehearse(**given["check"])
    for name in given["warm"]:
        with contextlib.suppress(Exception, SystemExit):  # the method's own process says what is missing
            importlib.import_module(name)
    first_gradient()
    gc.freeze()
    while True:
        variables, handles, _, _ = socket.recv_fds(control, 1 << 16, 3)
        if not variables:
            return
        if os.fork() == 0:
            control.close()
            _watch({**given, "environment": json.loads(variables)}, *handles)
        for handle in handles:
            os.close(handle)


def _rehearse(name: str, parameters: dict[str, Any]) -> None:
    """Test the contract of a method that ships: all that it loads is there for every process that is forked then."""
    from vsfsim.bench.check import check

    # PyTorch reads the number when it is imported, and a fork has no other thread; the method's own process says what
    # is wrong
    with one_thread(), contextlib.suppress(Exception, SystemExit):
        check(name, parameters=parameters, brief=True)


def prctl(option: int, value: int) -> None:
    """prctl(2); nothing happens on a system without it."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)


def _watch(given: dict[str, Any], line: int, end: int, log: int) -> None:
    """Fork the method's process, keep what it prints until it ends or is to end, end all that is left of it, and tell
    how it ended. Does not return.

    Args:
        given: as of `main`, and ``environment``, variables. line: of the method's process. end: closed to end it. log:
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
        status, usage = _keep(process, read, end, log, given["most"])
        said = {"code": os.waitstatus_to_exitcode(status),
                "peak_mib": usage.ru_maxrss / (1024.0 if sys.platform == "linux" else 1024.0**2)}
    except OSError as error:
        said = {"code": 1, "peak_mib": 0.0, "why": str(error)}
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        os.write(end, json.dumps(said).encode())
    os._exit(0)


def _begin(given: dict[str, Any]) -> None:
    """In the method's process. Does not return."""
    try:
        prctl(_DEATH_SIGNAL, signal.SIGKILL)  # it ends with the process that watches
        os.setsid()
        with contextlib.suppress(OSError):  # where memory is short the kernel ends this process before the user's
            Path("/proc/self/oom_score_adj").write_text("1000")
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        if given["box"] is None:
            prctl(_DUMPABLE, 1)
            os.chdir(given["folder"])
        else:
            box.enter({**given["box"], "root": given["folder"]})
            given["box"].clear()  # it names the dataset, and a method can look through the frames of its callers
            os.close(0)
            os.open("/dev/null", os.O_RDONLY)  # in the container it is read-only; the one from outside keeps a time
        os.environ.update(given["environment"])
        private_caches(Path.cwd(), given["cache"])
        limits.apply(given["memory"], given["box"] is not None)
        importlib.invalidate_caches()
        _answer(Connection(3))
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(0)


def _keep(process: int, read: int, end: int, log: int, most: int) -> tuple[int, Any]:
    """Copy what is printed, until the log has ``most`` bytes, while the process runs and is not to end; then end its
    descendants.

    Returns:
        The status of its end, and what it used (`resource.struct_rusage`).
    """
    handles, ended = [read, end], os.wait4(process, os.WNOHANG)
    while ended[0] == 0:
        ready = select.select(handles, [], [], 0.05)[0]
        if read in ready and not _copy(read, log, most):
            handles.remove(read)
        if end in ready:
            os.kill(process, signal.SIGKILL)
        ended = os.wait4(process, 0 if end in ready else os.WNOHANG)
    end_descendants()
    os.set_blocking(read, False)
    with contextlib.suppress(OSError):
        while _copy(read, log, most):
            pass
    return ended[1], ended[2]


def _copy(read: int, log: int, most: int) -> bytes:
    """What was printed now, b"" at its end."""
    text = os.read(read, 1 << 16)
    os.write(log, text[:max(most - os.fstat(log).st_size, 0)])
    return text


def end_descendants() -> None:
    """Kill all that runs below this process, which adopts whatever loses its parent, so that all are its own children
    in the end. In a container there is nothing left."""
    until, children = time.monotonic() + 20.0, Path(f"/proc/self/task/{os.getpid()}/children")
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < until:
            with contextlib.suppress(OSError):
                for child in children.read_text().split():
                    os.kill(int(child), signal.SIGKILL)
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
            time.sleep(0.002)


def _answer(line: Connection) -> None:
    """Answer requests until the scorer closes the line."""
    server = _Server()
    sys.addaudithook(server.watch)
    with contextlib.suppress(EOFError, OSError):
        while True:
            operation, payload = pickle.loads(line.recv_bytes())
            try:
                reply = getattr(server, f"do_{operation}")(payload) or Reply()
            except BaseException as error:  # a method may raise anything, SystemExit included
                traceback.print_exc()
                reply = _failure(error)
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(Exception):  # a method may have closed or replaced it
                    stream.flush()
            line.send_bytes(encoded(reply))


class _Server:
    """The method and what is asked of it."""

    def __init__(self) -> None:
        self.parameters = dict[str, Any]()
        self.factory: Any = None
        self.method: Any = None
        self.opened = set[bytes]()

    def watch(self, event: str, operands: tuple[Any, ...]) -> None:
        """The audit hook: keep the name of every file that is opened to be read."""
        if event == "open" and operands[1] in (None, "r", "rb", "rt"):
            with contextlib.suppress(TypeError, ValueError):  # a descriptor; no name of a file
                self.opened.add(os.path.abspath(os.fsencode(operands[0])))

    # ------------------------------------------------------------------ before the trials

    def do_find(self, payload: dict[str, Any]) -> Reply:
        self.factory = rules.find_method(payload["name"], search=payload["folder"])
        self.parameters = rules.parameters_of(self.factory, payload["parameters"])
        rules.plain_parameters(self.parameters)
        return Reply({"entry": f"{self.factory.__module__}:{getattr(self.factory, '__qualname__', self.factory)}",
                      "parameters": self.parameters, "seeded": "seed" in inspect.signature(self.factory).parameters})

    def do_check(self, name: str) -> Reply:
        from vsfsim.bench.check import check  # half of what a process would import that is not asked to check

        findings = check(name, parameters=self.parameters, brief=True)
        failed = (f for f in findings if f.outcome == "failed")
        return Reply({"failed": [[f.clause, plain(f.detail)] for f in failed]})

    def do_build(self, seed: int | None) -> None:
        self.method = rules.build_method(self.factory, {**self.parameters, **({} if seed is None else {"seed": seed})})

    def do_meta_fit(self, specimens: Any) -> None:
        _use_threads(int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1))
        self.method.meta_fit(specimens)

    def do_state(self, _: Any) -> Reply:
        cache = Path(os.environ["XDG_CACHE_HOME"])
        cached = {str(path.relative_to(cache)): path.read_bytes()
                  for path in sorted(cache.rglob("*")) if path.is_file() and not path.is_symlink()}
        return Reply({"host": getattr(self.method, "trials_on_host", False) is True,
                      "opened": sorted(self.opened)}, blob=pickle.dumps((packed(self.method), cached)))

    # ------------------------------------------------------------------ one trial

    def do_restore(self, state: bytes) -> None:
        learned, cached = pickle.loads(state)
        for name, content in cached.items():
            path = Path(os.environ["XDG_CACHE_HOME"], name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)  # a link to a kernel of the user's
            path.write_bytes(content)
        self.method = pickle.loads(learned)
        _use_threads(1)

    def do_adapt(self, operands: Any) -> Reply:
        self.method.adapt(*operands)
        return Reply({"offers": [name for name in OPTIONAL if callable(getattr(self.method, name, None))]})

    def do_choose(self, operands: Any) -> Reply:
        return Reply({"chosen": rules.checked_choice(self.method.choose(*operands), len(operands[-1]))})

    def do_predict(self, operands: Any) -> Reply:
        actions, names = operands
        return Reply(arrays=tuple(rules.checked_prediction(self.method.predict(actions), actions, names)))

    def do_stiffness(self, points: np.ndarray) -> Reply:
        given = self.method.stiffness(points)
        if getattr(given, "mean", None) is None:
            raise MethodError(f"stiffness must return an Estimate with a mean and a std; it "
                              f"returned {type(given).__name__}.")
        return Reply(arrays=(rules.numbers(given.mean, "stiffness has a mean"),))

    def do_locate(self, payload: Any) -> Reply:
        return Reply(arrays=(rules.numbers(self.method.locate(*payload),
                                           "locate must return a transform (4, 4), and not one"),))


def private_caches(folder: Path, kernels: str) -> None:
    """Give this process caches and a home of its own, with the kernels that the user has compiled already.

    Args:
        folder: in which they are made. kernels: the user's folder of them.
    """
    cache = folder / ".cache"
    private = cache / "warp"
    os.environ.update(HOME=str(folder), TMPDIR=str(folder), XDG_CACHE_HOME=str(cache), WARP_CACHE_PATH=str(private))
    tempfile.tempdir = None
    sys.dont_write_bytecode = True
    private.mkdir(parents=True, exist_ok=True)
    warp = sys.modules.get("warp")
    for part, _, names in os.walk(kernels) if warp is not None else ():
        here = os.path.normpath(os.path.join(private, os.path.relpath(part, kernels)))
        os.makedirs(here, exist_ok=True)
        for name in names:
            os.symlink(os.path.join(part, name), os.path.join(here, name))
    for name, made in (("TORCH_HOME", "torch"), ("HF_HOME", "huggingface")):  # weights, read-only in a container
        if name in os.environ:
            (cache / made).mkdir(parents=True)
            (cache / made / "hub").symlink_to(Path(os.environ[name]) / "hub")
            os.environ[name] = str(cache / made)
    if warp is not None and warp.config.kernel_cache_dir:
        warp.config.kernel_cache_dir = str(private / Path(warp.config.kernel_cache_dir).name)
        Path(warp.config.kernel_cache_dir).mkdir(parents=True, exist_ok=True)


def _use_threads(count: int) -> None:
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(count)


def first_gradient() -> None:
    """Take PyTorch's first gradient before any fork, if GPUs are hidden.

    With it a PyTorch built for CUDA asks the driver for the number of GPUs, also where all are hidden, and keeps the
    answer. Where Warp has started the driver, asking it in a fork ends with SIGSEGV.
    """
    torch = sys.modules.get("torch")
    if torch is not None and os.environ.get("CUDA_VISIBLE_DEVICES") == "":
        torch.zeros((), requires_grad=True).backward()


def _failure(error: BaseException) -> Reply:
    kind = "missing" if isinstance(error, MissingPackage) else "refused" if isinstance(error, VsfsimError) else "raised"
    return Reply({"error": kind, "type": plain(type(error).__name__), "text": plain(error)})
