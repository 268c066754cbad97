"""The scorer's side of a method's processes: it starts them, asks them, times them and ends them."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import pickle
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import vsfsim
from vsfsim.bench.identity import named_by
from vsfsim.bench.isolation.limits import LARGEST_FOLDER, LARGEST_LOG, Isolation, environment, kernels, places
from vsfsim.bench.isolation.wire import Garbled, Reply, receive_reply
from vsfsim.bench.method import Specimen
from vsfsim.core.errors import MethodError
from vsfsim.core.extras import EXTRA_OF, MissingPackage
from vsfsim.core.plain_text import plain
from vsfsim.core.shelf import methods
from vsfsim.core.system.content import named_files, named_folders

_START = ("import sys, json; given = json.load(sys.stdin); sys.path[:] = given['search']; "
          "from vsfsim.bench.isolation.child import main; main(given)")
_IMPORT = 120.0
"""Seconds that the import of a method's packages may take besides --timeout."""
# calls of the method that its check makes at most, each of which may take --timeout: twelve, and six of the functions
# that a method may leave out
_CALLS = 20
_STATE = 1 << 34
"""Most bytes of what a method learned."""
_WARM = {"vsfsim", "numpy", "scipy", "h5py", *EXTRA_OF}
"""Packages that may be imported before a method's process is forked."""


@dataclass(frozen=True)
class Description:
    """What a method says of itself before it is built."""

    entry: str
    """Its module:attribute."""
    parameters: Mapping[str, Any]
    """Of the constructor, all of them."""
    seeded: bool
    """Its constructor takes a ``seed``."""


UNKNOWN = Description("", {}, False)
"""Of a method that was not looked at."""


@dataclass(frozen=True)
class Learned:
    """What a method learned in one training."""

    state: bytes
    """Read by processes of the same method only."""
    on_host: bool
    """Its trials need no GPU."""
    opened: tuple[str, ...]
    """Files that its process opened."""
    seconds: float
    """That `meta_fit` took."""
    environment: Mapping[str, str]
    """Variables that it was given."""


class MethodHost(contextlib.AbstractContextManager["MethodHost"]):
    """Runs the processes of one method.

    Use it as a context manager. The module of the method is imported in these processes, never here.

    Args:
        name: of the method, as `vsfsim.bench.method.find_method` takes it.
        parameters: of its constructor, over its defaults.
        isolation: what it is kept from.
        log: file to which everything goes that it prints.
        hidden: folders that a container must not show.

    Raises:
        MethodError: a parameter names a folder that holds one of them.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any], isolation: Isolation, log: Path, *,
                 hidden: Sequence[Path] = ()):
        if os.name == "nt":
            raise MethodError("`vsfsim evaluate` runs a method in a process of its own in ways that "
                              "Windows does not have. Use it under WSL, or write predictions to a "
                              "file and use `vsfsim lab score`.")
        self.name, self.parameters, self.isolation, self.log = name, dict(parameters), isolation, log.absolute()
        self.ships = name in methods() and methods()[name].value.startswith("vsfsim.")
        device = self.parameters.get("device", "cpu" if self.ships else None)  # of those that ship, a cpu if none given
        self._on_gpu = device != "cpu" and bool(glob.glob("/dev/nvidia[0-9]*") + glob.glob("/dev/kfd"))
        self.hides = device == "cpu"
        """No process sees a GPU."""
        named = named_folders(self.parameters, "") if isolation.sandbox != "process" else {}
        for text, path in named.items():
            if inside := [one for one in hidden if one.is_dir() and one.is_relative_to(path.resolve())]:
                raise MethodError(f"a parameter of {name} names the folder '{text}', in which "
                                  f"{inside[0]} lies, which no method may see. Name one that holds "
                                  f"what the method needs and nothing else.")
        self.folders = tuple(named)
        """Folders that parameters name, whose files no process of the method can change."""
        self._folder = Path(tempfile.mkdtemp(prefix="vsfsim-method-")).resolve()
        # the working folder only where vsfsim itself lies in it: its other modules are the user's
        self._search = [path for path in dict.fromkeys(map(os.path.abspath, filter(None, sys.path)))
                        if path != os.getcwd() or path == str(Path(vsfsim.__path__[0]).parent)]
        self._places = {"size": LARGEST_FOLDER, **places(
            name, self.parameters, search=self._search, hidden=hidden, given=environment(os.environ))}
        self._kernels = kernels()
        if isolation.sandbox == "process":  # which could write through links to the user's
            self._kernels = str(self._folder / "kernels")
            with contextlib.suppress(OSError):  # one that just went is compiled again
                shutil.copytree(kernels(), self._kernels)
        self._lock, self._hosts = threading.Lock(), dict[bool, tuple[subprocess.Popen[bytes], socket.socket]]()
        self.processes = set[Process]()
        self.peak_memory_mib = 0.0
        """Largest resident size that a process has had [MiB]."""

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all processes, whatever they do. Safe to call twice."""
        for process in list(self.processes):
            process.end()
        for host, control in list(self._hosts.values()):
            control.close()
            try:
                host.wait(timeout=30.0)
            except subprocess.TimeoutExpired:
                host.kill()
                host.wait()
        self._hosts.clear()
        shutil.rmtree(self._folder, ignore_errors=True)

    # ------------------------------------------------------------------ what is asked of a method

    def look(self, *, check: bool) -> Description:
        """Import the method, and test on mock objects whether it keeps its contract.

        Raises:
            MethodError: it is unknown, or breaks its contract; with every clause that it breaks.
        """
        with self._process(self.hides, {}, self.name) as process:
            head, limit = process.about, self.isolation.timeout
            try:
                parameters = dict(json.loads(json.dumps(head["parameters"], allow_nan=False)))
                said = Description(plain(head["entry"]), parameters, bool(head["seeded"]))
                found = process.ask("check", self.name, "the check of its contract",
                                    limit=limit and _CALLS * limit).head["failed"] if check else []
                failed = "; ".join(f"{plain(clause)}: {plain(detail)}" for clause, detail in found)
            except (KeyError, TypeError, ValueError) as error:
                raise MethodError(f"the process of {self.name} described itself with something unreadable.") from error
        if failed:
            raise MethodError(f"{self.name} does not keep the contract of a method: {failed} "
                              f"`vsfsim check {self.name}` tests all of it.")
        return said

    def learn(self, specimens: Sequence[Specimen], *, seed: int | None,
              environment: Mapping[str, str] | None = None) -> Learned:
        """Build the method in a process of its own and let it learn.

        Args:
            specimens: training objects. seed: for a method that takes one. environment: further variables.
        """
        given = environment or {}
        with self._process(self.hides, given) as process:
            process.ask("build", seed, "its constructor")
            process.ask("meta_fit", specimens, f"meta_fit on {len(specimens)} objects")
            reply = process.ask("state", None, "a copy of what it learned", most=_STATE)
        # a container's own files are no one else's, whatever lies here at their paths
        shown = tuple(f"{path}/" for path in ([""] if self.isolation.sandbox == "process" else self._places["shown"]))
        said = reply.head.get("opened")
        names = [os.path.normpath(os.fsdecode(name))
                 for name in (said if isinstance(said, list) else ()) if isinstance(name, bytes)]
        opened = tuple(name for name in names
                       if "/__pycache__/" not in name and f"{name}/".startswith(shown))
        return Learned(reply.blob, reply.head.get("host") is True, opened,
                       process.seconds["meta_fit"], given)

    @contextmanager
    def trial(self, learned: Learned) -> Iterator[Process]:
        """A process with a fresh copy of the method that learned."""
        with self._process(self.hides or learned.on_host, learned.environment) as process:
            process.ask("restore", learned.state, "the copy of what it learned")
            yield process

    # ------------------------------------------------------------------ processes

    @contextmanager
    def _process(self, hide: bool, environment: Mapping[str, str], name: str = "") -> Iterator[Process]:
        """A process that has imported the method, by its own ``name`` if it is given, as whoever looks at it first has
        the better message."""
        process, limit = self._start(hide, environment), self.isolation.timeout
        self.processes.add(process)
        try:
            found = name or (self.name if ":" in self.name else methods()[self.name].value)
            given = {"name": found, "parameters": self.parameters, "folder": os.getcwd()}
            process.about = process.ask("find", given, "its import",
                                        limit=None if limit is None else limit + _IMPORT).head
            yield process
        finally:
            self.processes.discard(process)
            process.end()
            self.peak_memory_mib = max(self.peak_memory_mib, process.peak_memory_mib)

    def _start(self, hide: bool, environment: Mapping[str, str]) -> Process:
        (line, theirs), (end, watcher) = socket.socketpair(), socket.socketpair()
        try:
            with self._lock, open(self.log, "ab") as log:
                socket.send_fds(self._host(hide), [json.dumps(dict(environment)).encode()],
                                [theirs.fileno(), watcher.fileno(), log.fileno()])
        except OSError as error:
            raise MethodError(f"a process of {self.name} cannot be started: {error}. {self.tail(3)}") from error
        finally:
            theirs.close()
            watcher.close()
        return Process(self, line, end)

    def _host(self, hide: bool) -> socket.socket:
        """The line of the process that others are forked from, with or without the machine's GPUs."""
        if hide not in self._hosts:
            ours, theirs = socket.socketpair()
            # none of the method's modules, and none that starts a GPU's driver, which is of no use after a fork
            tops = {"numpy", "scipy"} if self._on_gpu and not hide else _WARM
            warm = [name for name in named_by(self.name) if name.partition(".")[0] in tops and "__" not in name]
            # Of one that ships, the contract's check loads its kernels, and compiles them for the user's own folder.
            check = {"name": self.name, "parameters": self.parameters} if (
                self.ships and self.hides and not named_files(self.parameters, "")) else None
            given = {"search": self._search, "control": theirs.fileno(), "warm": warm,
                     "box": self._places if self.isolation.sandbox != "process" else None,
                     "cache": self._kernels, "folder": str(self._folder), "check": check,
                     "most": LARGEST_LOG, "memory": self.isolation.memory}
            # Threads of OpenBLAS spin while they wait: where processes run side by side, most of their time is that.
            variables = {"OPENBLAS_NUM_THREADS": "1", **environment(os.environ), **(
                {"CUDA_VISIBLE_DEVICES": ""} if hide else {}), "WARP_CACHE_PATH": kernels()}
            with open(self.log, "ab") as log:
                host = subprocess.Popen([sys.executable, "-c", _START], stdin=subprocess.PIPE, stdout=log,
                                        stderr=log, cwd=self._folder, env=variables,
                                        pass_fds=[theirs.fileno()], start_new_session=True)
            theirs.close()
            self._hosts[hide] = host, ours
            with host.stdin as words:  # type: ignore[union-attr]
                words.write(json.dumps(given).encode())
        return self._hosts[hide][1]

    def tail(self, lines: int = 30) -> str:
        """The last lines of what the method printed."""
        try:
            with open(self.log, "rb") as file:
                file.seek(max(0, self.log.stat().st_size - 20_000))
                return "\n".join(file.read().decode(errors="replace").splitlines()[-lines:])
        except OSError:
            return ""


class Process:
    """One process of a method's."""

    def __init__(self, host: MethodHost, line: socket.socket, end: socket.socket):
        self._host, self._end = host, end
        self._line, self._closing = Connection(line.detach()), threading.Lock()
        self._timed_out = ""
        self._said: dict[str, Any] = {}
        self.about: dict[str, Any] = {}
        """What the method says of itself."""
        self.seconds = defaultdict[str, float](float)
        """That each operation took, by its name."""
        self.peak_memory_mib = 0.0
        """Largest resident size that it has had, once it has ended [MiB]."""

    def ask(self, operation: str, payload: Any, what: str, *, most: int = 1 << 26,
            limit: float | None = -1.0) -> Reply:
        """The answer to a request.

        Args:
            operation: its name. payload: its operands, which are pickled, as the process trusts the scorer. what: names
            it in messages. most: bytes of the answer. limit: seconds, None for no limit; default: the isolation's.

        Raises:
            MethodError: the method raised, refused or took too long, or its process ended; ``what`` says in which part.
        """
        limit = self._host.isolation.timeout if limit == -1.0 else limit
        timer = threading.Timer(limit or threading.TIMEOUT_MAX, self._stop, (limit, what))
        timer.daemon = True
        start = time.perf_counter()
        try:
            if limit is not None:
                timer.start()
            self._line.send_bytes(pickle.dumps((operation, payload), protocol=5))
            reply = receive_reply(self._line, most=most)
        except (EOFError, OSError):
            raise MethodError(self._ended(what)) from None
        except Garbled as error:
            raise MethodError(f"the method's process gave no answer in {what}: {error}.") from error
        finally:
            timer.cancel()
            self.seconds[operation] += time.perf_counter() - start
        kind = reply.head.get("error")
        if kind is None:
            return reply
        text = plain(reply.head.get("text", ""))
        if kind in ("missing", "refused"):
            raise (MissingPackage if kind == "missing" else MethodError)(text)
        raised = plain(reply.head.get("type", "an error"))
        failure = MethodError(f"the method raised {raised} in {what}: {text.rstrip('.')}."
                              f"{self._notes(reply.head.get('type'))} --debug shows where.")
        failure.add_note(self._host.tail())
        raise failure

    def _stop(self, limit: float, what: str) -> None:
        self._timed_out = (f"{what} took longer than {limit:g} s; --timeout is "
                           f"{self._host.isolation.timeout:g} s a call. Give more time, or make it faster.")
        self._finish()

    def _notes(self, kind: str | None) -> str:
        isolation = self._host.isolation
        if isolation.sandbox != "process" and kind in ("FileNotFoundError", "OSError",
                                                       "PermissionError", "ModuleNotFoundError"):
            return (f" It runs in a container (--sandbox {isolation.sandbox}), which shows the installed packages, its "
                    f"source and what its parameters name, and can be written in its working folder only. Name the "
                    f"file by a parameter, or put it into the method's package.")
        short = kind in ("MemoryError", None) and isolation.memory is not None
        return f" It may allocate {isolation.memory:g} GiB (--memory)." if short else ""

    def _ended(self, what: str) -> str:
        self._finish()
        if self._timed_out:
            return self._timed_out
        if "why" in self._said:
            return f"the container of {self._host.name} cannot be made: {self._said['why']}."
        code, lines = int(self._said.get("code", 1)), self._host.tail(3)
        how = f"exit code {code}" if code >= 0 else signal.strsignal(-code) or f"signal {-code}"
        return (f"the method's process ended in {what} ({how}).{self._notes(None)}"
                + (f" Its last words: {plain(lines)}" if lines.strip() else ""))

    def end(self) -> None:
        """End the process and all that it started."""
        self._finish()
        with self._closing:  # the thread that stops an evaluation ends it, too
            self._line.close()
        self._end.close()

    def _finish(self) -> None:
        """Have the process ended, and note what is said of its end."""
        with contextlib.suppress(OSError, ValueError):
            self._end.shutdown(socket.SHUT_WR)
            if not self._said and select.select([self._end], [], [], 30.0)[0]:
                self._said = json.loads(self._end.recv(1 << 12))
                self.peak_memory_mib = float(self._said["peak_mib"])
