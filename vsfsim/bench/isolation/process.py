"""The scorer's side of a method's process: it starts it, asks it, times it and ends it."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.isolation import container, keeper, namespaces
from vsfsim.bench.isolation.limits import LARGEST_LOG, Isolation, environment
from vsfsim.bench.isolation.wire import Channel, Closed, Garbled, Reply
from vsfsim.bench.method import Specimen
from vsfsim.core.errors import MethodError
from vsfsim.core.extras import MissingPackage
from vsfsim.core.plain_text import plain

_START = "import sys, json; sys.path[:] = json.loads(sys.argv[1])['search']; " \
         "from vsfsim.bench.isolation.child import main; main(sys.argv[1:])"
_IMPORT = 120.0
"""Seconds that starting Python and importing a method's packages may take besides --timeout."""
_STATE = 1 << 34
"""Most bytes of what a method learned."""


@dataclass(frozen=True)
class Description:
    """What a method says of itself before it is built."""

    entry: str
    """Its module:attribute."""
    parameters: Mapping[str, Any]
    """Of the constructor, all of them."""
    seeded: bool
    """Its constructor takes a ``seed``."""
    package: str
    """The installed package that it is from, "" for a file that is not installed."""
    version: str
    """Of that package."""


class MethodProcess:
    """A process with one method.

    Use it as a context manager. The module of the method is imported in the process, never here.

    Args:
        name: of the method, as `vsfsim.bench.method.find_method` takes it.
        parameters: of its constructor, over its defaults.
        isolation: what it is kept from.
        log: file to which everything goes that it prints.
        hidden: folders that a container must not show.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any], isolation: Isolation, log: Path, *,
                 hidden: Sequence[Path] = ()):
        self.name, self.parameters, self.isolation, self.log, self.hidden = name, parameters, isolation, log, hidden
        self._folder = Path(tempfile.mkdtemp(prefix="vsfsim-method-")).resolve()
        for name in ("work", "root"):
            (self._folder / name).mkdir()
        self._state: bytes | None = None  # what the method learned, where it cannot be forked
        self._copy: MethodProcess | None = None  # which received that state and can be forked
        self._seed: int | None = None
        self._process: subprocess.Popen[bytes] | None = None
        if os.name == "nt":
            raise MethodError("`vsfsim evaluate` runs a method in a process of its own in ways that Windows does not "
                              "have. Use it under WSL, or write predictions to a file and use `vsfsim score`.")
        self._channels: list[Channel] = []
        self._free: list[Channel] = []
        self._waiting = threading.Condition()
        self._timed_out = ""
        self.peak_memory_mib = 0.0
        """Largest resident size that the process, or a trial, has reported [MiB]."""
        try:
            self._start(1 + (isolation.workers if hasattr(os, "fork") else 0))
            self.description = self._find()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> MethodProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process, whatever it does. Safe to call twice."""
        if self._copy is not None:
            self._copy.close()
        self._kill()
        if self._process is not None:
            try:
                self._process.wait(timeout=30.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for channel in self._channels:
            with contextlib.suppress(OSError):
                channel.close()
        self._channels = []
        shutil.rmtree(self._folder, ignore_errors=True)

    # ------------------------------------------------------------------ before the trials

    def check(self) -> list[tuple[str, str]]:
        """The clauses of the contract that the method breaks on mock objects, each with what was observed."""
        reply = self._ask(self._channels[0], "check", None, "the check of its contract")
        return [(plain(clause), plain(detail)) for clause, detail in reply.head.get("failed", [])]

    def require(self) -> None:
        """Refuse a method that breaks its contract on mock objects.

        Raises:
            MethodError: with every clause that it breaks.
        """
        failed = self.check()
        if failed:
            raise MethodError(f"{self.name} does not keep the contract of a method: "
                              + "; ".join(f"{clause}: {detail}" for clause, detail in failed)
                              + f" `vsfsim check {self.name}` tests all of it.")

    def meta_fit(self, specimens: Sequence[Specimen], *, seed: int | None) -> float:
        """Build the method, let it learn, and make ready for trials.

        Args:
            specimens: training objects. seed: for a method that takes one.

        Returns:
            Seconds that `meta_fit` took.
        """
        control, self._seed = self._channels[0], seed
        self._ask(control, "build", seed, "its constructor")
        start = time.perf_counter()
        reply = self._ask(control, "meta_fit", specimens, f"meta_fit on {len(specimens)} objects")
        took = time.perf_counter() - start
        if not self._serves(reply):
            self._state = self._ask(control, "state", None, "a copy of what it learned", most=_STATE).blob
            copy = self._restored(self.isolation.workers)
            if copy._free:
                self._copy = copy
            else:
                copy.close()
        return took

    def _serves(self, learned: Reply) -> bool:
        """Have the process fork for trials, if it says in its answer that it can."""
        if learned.head.get("fork") is not True or len(self._channels) < 2:
            return False
        self._ask(self._channels[0], "serve", None, "the start of its trials")
        self._free = self._channels[1:]
        return True

    def _restored(self, workers: int) -> MethodProcess:
        """A new process with what the method learned; it serves trials if it can be forked."""
        process = MethodProcess(self.name, self.parameters, replace(self.isolation, workers=workers), self.log,
                                hidden=self.hidden)
        try:
            control = process._channels[0]
            process._ask(control, "build", self._seed, "its constructor")
            process._serves(process._ask(control, "restore", self._state, "the copy of what it learned"))
        except BaseException:
            process.close()
            raise
        return process

    # ------------------------------------------------------------------ trials

    @contextmanager
    def trial(self, view: Any, support: Sequence[Any], where: str) -> Iterator[MethodCopy]:
        """A fresh copy of the method that learned, which holds one view and one support set.

        Args:
            view: of the object. support: the touches that were made. where: for messages.
        """
        if self._copy is not None:
            with self._copy.trial(view, support, where) as one:
                yield one
            self.peak_memory_mib = max(self.peak_memory_mib, self._copy.peak_memory_mib)
            return
        if self._state is not None:
            with self._restored(1) as process:
                yield from process._one_trial(process._channels[0], view, support, where)
            return
        with self._waiting:
            while not self._free:
                self._waiting.wait()
            channel = self._free.pop()
        try:
            yield from self._one_trial(channel, view, support, where)
        finally:
            with self._waiting:
                self._free.append(channel)
                self._waiting.notify()

    def _one_trial(self, channel: Channel, view: Any, support: Sequence[Any], where: str) -> Iterator[MethodCopy]:
        self._ask(channel, "object", (view, list(support)), where)
        yield MethodCopy(self, channel, where)
        self._ask(channel, "end", None, where)

    # ------------------------------------------------------------------ the process

    def _start(self, channels: int) -> None:
        pairs, theirs = [], []
        for _ in range(channels):
            ask, answer = os.pipe(), os.pipe()
            self._channels.append(Channel(answer[0], ask[1]))
            pairs.append((ask[0], answer[1]))
            theirs += [ask[0], answer[1]]
        search = list(dict.fromkeys(os.path.abspath(path) for path in sys.path))
        given = {"channels": pairs, "search": search, "memory": self.isolation.memory}
        words, enter = [sys.executable, "-c", _START, json.dumps(given)], None
        if self.isolation.sandbox == "process":
            keeper.hide_memory()  # of the scorer, which a process of the same user could else attach to
        else:
            where = container.places(self.name, self.parameters, search=search, hidden=self.hidden,
                                     folder=self._folder / "work")
            if self.isolation.sandbox == "bubblewrap":
                words = container.bubblewrap(words, where)
            else:
                enter = container.entry(where, self._folder / "root")
        kept = {"words": words, "enter": enter, "namespaces": namespaces.__file__, "handles": theirs,
                "log": str(Path(self.log).absolute()), "most": LARGEST_LOG, "parent": os.getpid(),
                "inside": self.isolation.sandbox != "process"}
        try:
            with open(self.log, "ab") as log:
                self._process = subprocess.Popen([sys.executable, "-I", "-S", keeper.__file__, json.dumps(kept)],
                                                 stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                                                 cwd=self._folder / "work", env=environment(os.environ),
                                                 pass_fds=theirs, start_new_session=True)
        except OSError as error:
            raise MethodError(f"the process of {self.name} cannot be started: {error}.") from error
        finally:
            for handle in theirs:
                os.close(handle)

    def _find(self) -> Description:
        reply = self._ask(self._channels[0], "find", {"name": self.name, "parameters": dict(self.parameters),
                                                      "folder": os.getcwd()}, "its import",
                          limit=None if self.isolation.timeout is None else self.isolation.timeout + _IMPORT)
        try:
            head = reply.head
            package, version = (plain(word) for word in head["package"])
            return Description(plain(head["entry"]), dict(head["parameters"]), bool(head["seeded"]), package, version)
        except (KeyError, TypeError, ValueError) as error:
            raise MethodError(f"the process of {self.name} described itself with something unreadable.") from error

    def _ask(self, channel: Channel, operation: str, payload: Any, what: str, *, most: int = 1 << 20,
             limit: float | None = -1.0) -> Reply:
        """The answer to a request.

        Raises:
            MethodError: the method raised, refused, took too long, or its process ended; ``what`` says in which part.
        """
        limit = self.isolation.timeout if limit == -1.0 else limit
        timer, part = self._timer(limit, what), what
        try:
            channel.send_request(operation, payload)
            reply = channel.receive_reply(most=most)
            while "calls" in reply.head and operation == "check":  # each call of the check has the whole limit
                if timer is not None:
                    timer.cancel()
                part = f"{plain(reply.head['calls'], longest=60)} in {what}"
                timer = self._timer(limit, part)
                reply = channel.receive_reply(most=most)
        except Closed:
            raise MethodError(self._ended(part)) from None
        except Garbled as error:
            raise MethodError(f"the method's process gave no answer in {what}: {error}.") from error
        finally:
            if timer is not None:
                timer.cancel()
        kind, peak = reply.head.get("error"), reply.head.get("peak_mib", 0.0)
        if isinstance(peak, (int, float)) and self.peak_memory_mib < peak < 1e9:
            self.peak_memory_mib = float(peak)
        if "over" in reply.head and operation != "end":
            kind, reply.head["text"] = "died", reply.head["over"]
        if kind is None:
            return reply
        text, said = plain(reply.head.get("text", "")), ""
        if kind == "missing":
            raise MissingPackage(text)
        if kind == "refused":
            raise MethodError(text)
        if kind == "died":
            said = f"the method's process ended in {what} ({text})"
        else:
            said = f"the method raised {plain(reply.head.get('type', 'an error'))} in {what}: {text}"
        failure = MethodError(f"{said.rstrip('.')}.{self._memory_note(reply.head)}{self._box_note(reply.head)} --debug "
                              f"shows where.")
        failure.add_note(self.tail())
        raise failure

    def _timer(self, limit: float | None, what: str) -> threading.Timer | None:
        if limit is None:
            return None
        timer = threading.Timer(limit, self._stop, (f"{what} took longer than the {limit:g} s of --timeout",))
        timer.daemon = True
        timer.start()
        return timer

    def _box_note(self, head: Mapping[str, Any]) -> str:
        if self.isolation.sandbox == "process" or head.get("type") not in ("FileNotFoundError", "OSError",
                                                                           "PermissionError"):
            return ""
        return (f" It runs in a container (--sandbox {self.isolation.sandbox}), which shows the installed packages and "
                f"what its parameters name, and can be written in its working folder only.")

    def _memory_note(self, head: Mapping[str, Any]) -> str:
        short = self.isolation.memory is not None and head.get("type") in ("MemoryError", None)
        return f" It may allocate {self.isolation.memory:g} GiB (--memory)." if short else ""

    def _ended(self, what: str) -> str:
        if self._timed_out:
            return f"{self._timed_out}. Give more time, or make it faster."
        with contextlib.suppress(OSError):
            if self.log.stat().st_size >= LARGEST_LOG:
                return (f"the method has printed more than {LARGEST_LOG >> 20} MiB, the last of it in {what}. Print "
                        f"less.")
        code = None
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(timeout=5.0)
        lines = self.tail(3)
        how = "" if code is None else f" (signal {-code})" if code < 0 else f" (exit code {code})"
        return (f"the method's process ended in {what}{how}.{self._memory_note({})}"
                + (f" Its last words: {plain(lines)}" if lines.strip() else ""))

    def _stop(self, why: str) -> None:
        self._timed_out = why
        self._kill()

    def _kill(self) -> None:
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(OSError):
                self._process.terminate()  # it ends all that runs below it

    def tail(self, lines: int = 30) -> str:
        """The last lines of what the method printed."""
        try:
            with open(self.log, "rb") as file:
                file.seek(max(0, self.log.stat().st_size - 20_000))
                return "\n".join(file.read().decode(errors="replace").splitlines()[-lines:])
        except OSError:
            return ""


class MethodCopy:
    """One adaptation of a fresh copy of the method."""

    def __init__(self, process: MethodProcess, channel: Channel, where: str):
        self._process, self._channel, self._where = process, channel, where
        self.offers: frozenset[str] = frozenset()
        """The optional functions that the method has."""
        self.adapt_s = 0.0
        """Seconds of `adapt`."""
        self.predict_s = 0.0
        """Seconds of all questions after it."""

    def adapt(self) -> None:
        """Adapt to the view and the support set of the trial."""
        start = time.perf_counter()
        reply = self._process._ask(self._channel, "adapt", None, f"adapt to {self._where}")
        self.adapt_s += time.perf_counter() - start
        self.offers = frozenset(str(name) for name in reply.head.get("offers", ()))

    def made(self, reading: Any) -> None:
        """Give one more touch to the support set, for the next `adapt`."""
        self._process._ask(self._channel, "made", reading, f"a touch for {self._where}")

    def ask(self, function: str, payload: Any, shapes: Sequence[tuple[int, ...]] | None) -> tuple[np.ndarray, ...]:
        """What a function of the method answers.

        Args:
            function: its name. payload: its operands. shapes: of the arrays of the answer; None where the scorer looks
                at them itself.

        Raises:
            MethodError: also if the answer has other shapes.
        """
        what = f"{function} for {self._where}"
        most = 1 << 26 if shapes is None else 8 * sum(int(np.prod(shape)) for shape in shapes)
        start = time.perf_counter()
        reply = self._process._ask(self._channel, function, payload, what, most=most)
        self.predict_s += time.perf_counter() - start
        if shapes is not None and [array.shape for array in reply.arrays] != list(shapes):
            raise MethodError(f"the method's process gave no answer in {what}: arrays of other shapes.")
        return reply.arrays
