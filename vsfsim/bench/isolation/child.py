"""The process of a method: it learns once, and forks for every trial, so that each begins with what was learned.

`main` is started by `vsfsim.bench.isolation.process`. The first channel asks to find the method, to check it and to let
it learn; ``serve`` then forks one process for each other channel, which forks again for each trial. What a trial
receives is read after that fork, so no process that outlives the trial ever holds it.

Where that process cannot be forked, because a GPU is in use, the scorer hands the state that ``state`` returned (the
pickled method, or the files of its `save`) to a new process, which forks for the trials if no GPU is in use in it, or
to a new one for each trial. GPUs are hidden from the new process if the method says that its trials need none
(``trials_on_host``).
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import select
import signal
import sys
import tarfile
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.isolation import limits
from vsfsim.bench.isolation.keeper import adopt_orphans, end_descendants, hide_memory
from vsfsim.bench.isolation.limits import peak_memory_mib
from vsfsim.bench.isolation.wire import Channel, Closed
from vsfsim.bench.method import Method, build_method, checked_choice, checked_prediction, find_method, parameters_of
from vsfsim.core.errors import MethodError, VsfsimError
from vsfsim.core.extras import MissingPackage
from vsfsim.core.shelf import methods

OPTIONAL = ("predict_std", "stiffness", "locate", "choose")
"""Functions of a method that the scorer asks for where they exist."""


def main(words: Sequence[str]) -> None:
    """Answer requests until the scorer closes the first channel.

    Args:
        words: one JSON text: ``channels``, pairs of file descriptors (receive, send); ``search``, the folders of
            ``sys.path``; ``memory``, see `limits.apply`.
    """
    given = json.loads(words[0])
    limits.end_with_parent()
    limits.apply(given["memory"])
    with contextlib.suppress(AttributeError):
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    channels = [Channel(*pair) for pair in given["channels"]]
    with contextlib.suppress(Closed):
        _Server(channels).run(channels[0])


class _Server:
    """The method and what is asked of it."""

    def __init__(self, channels: Sequence[Channel]):
        self.channels = channels
        self.name, self.parameters = "", dict[str, Any]()
        self.factory: type | None = None
        self.method: Any = None
        self.view: Any = None
        self.support: list[Any] = []
        self.is_fork = False

    def run(self, channel: Channel) -> None:
        """Answer the requests of one channel until it says "end".

        Raises:
            Closed: the scorer has closed the channel.
        """
        while True:
            operation, payload = channel.receive_request()
            if operation == "end" and self.is_fork:
                return  # the process that forked this one answers when it has seen the end
            try:
                head, arrays, blob = getattr(self, f"do_{operation}")(payload)
            except BaseException as error:  # a method may raise anything, SystemExit included
                traceback.print_exc()
                head, arrays, blob = _failure(error), (), b""
            sys.stdout.flush()
            sys.stderr.flush()
            channel.send_reply(head, arrays, blob)
            if operation == "end":
                return

    # ------------------------------------------------------------------ before the trials

    def do_find(self, payload: dict[str, Any]) -> Any:
        self.name = payload["name"]
        _hide_gpus(self.name, payload["parameters"])
        self.factory = find_method(self.name, search=payload["folder"])
        self.parameters = parameters_of(self.factory, payload["parameters"])
        try:
            json.dumps(self.parameters, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise MethodError(f"a parameter of {self.name} cannot be written into a result file: {error}. Use numbers, "
                              f"text, lists.") from error
        import inspect

        entry = f"{self.factory.__module__}:{getattr(self.factory, '__qualname__', self.factory)}"
        return {"entry": entry, "parameters": self.parameters,
                "seeded": "seed" in inspect.signature(self.factory).parameters,
                "package": list(_package(self.name, self.factory))}, (), b""

    def do_check(self, _: Any) -> Any:
        from vsfsim.bench.check import check  # half of what a process would import that is not asked to check

        findings = check(self.name, parameters=self.parameters, brief=True,
                         before=lambda call: self.channels[0].send_reply({"calls": call}))
        return {"failed": [[f.clause, f.detail] for f in findings if f.outcome == "failed"]}, (), b""

    def do_build(self, seed: int | None) -> Any:
        assert self.factory is not None
        more = {} if seed is None else {"seed": seed}
        self.method = build_method(self.factory, {**self.parameters, **more})
        return {}, (), b""

    def do_meta_fit(self, specimens: Any) -> Any:
        self.method.meta_fit(specimens)
        return {"fork": self._may_fork(), "peak_mib": peak_memory_mib()}, (), b""

    def _may_fork(self) -> bool:
        """Whether trials may be forks of this process: what they are to use, it must not have begun to use."""
        asked = str(self.parameters.get("device", "")).startswith("cuda") and not _gpus_are_hidden()
        return hasattr(os, "fork") and not (_driver_is_loaded() if asked else _uses_gpu())

    def do_state(self, _: Any) -> Any:
        return {}, (), _packed(self.method)

    def do_restore(self, state: bytes) -> Any:
        if getattr(self.method, "trials_on_host", False):
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        self.method = _unpacked(state, self.method)
        return {"fork": self._may_fork()}, (), b""

    def do_serve(self, _: Any) -> Any:
        _first_gradient()
        for channel in self.channels[1:]:
            if os.fork() == 0:
                _serve(self, channel)
        return {}, (), b""

    # ------------------------------------------------------------------ one trial

    def do_object(self, payload: Any) -> Any:
        self.view, self.support = payload
        return {}, (), b""

    def do_adapt(self, _: Any) -> Any:
        self.method.adapt(self.view, self.support)
        return {"offers": [name for name in OPTIONAL if callable(getattr(self.method, name, None))]}, (), b""

    def do_choose(self, offered: Any) -> Any:
        return {}, [np.array([float(checked_choice(self.method.choose(self.view, list(self.support), offered),
                                                   len(offered)))])], b""

    def do_made(self, reading: Any) -> Any:
        self.support = [*self.support, reading]
        return {}, (), b""

    def do_predict(self, payload: Any) -> Any:
        actions, names = payload
        return {}, checked_prediction(self.method.predict(actions), actions, names), b""

    def do_predict_std(self, payload: Any) -> Any:
        actions, names = payload
        return {}, checked_prediction(self.method.predict_std(actions), actions, names), b""

    def do_stiffness(self, points: np.ndarray) -> Any:
        given = self.method.stiffness(points)
        out = []
        for key in ("mean", "std"):
            value = getattr(given, key, None)
            if value is None and key == "mean":
                raise MethodError(f"stiffness must return an Estimate with a mean and a std; it returned "
                                  f"{type(given).__name__}.")
            try:
                out.append(np.zeros(0) if value is None else np.asarray(value, float))
            except (TypeError, ValueError) as error:
                raise MethodError(f"stiffness has a {key} that is not an array of real numbers: {error}.") from error
        return {}, out, b""

    def do_locate(self, payload: Any) -> Any:
        pose = self.method.locate(*payload)
        try:
            return {}, [np.asarray(pose, float)], b""
        except (TypeError, ValueError) as error:
            raise MethodError(f"locate must return a transform (4, 4) of real numbers: {error}.") from error

    def do_end(self, _: Any) -> Any:
        return {"peak_mib": peak_memory_mib()}, (), b""


def _serve(server: _Server, channel: Channel) -> None:
    """Run the trials of one channel, each in a fork of this process. Does not return."""
    try:
        limits.end_with_parent()
        adopt_orphans()
        hide_memory()
        for other in server.channels:
            if other is not channel:
                other.close()
        while True:
            select.select([channel.receive], [], [])  # a request waits, or the scorer has closed the channel
            trial = os.fork()
            if trial == 0:
                limits.end_with_parent()
                _one_thread()
                server.is_fork = True
                with contextlib.suppress(Closed):
                    server.run(channel)
                os._exit(0)
            _, status = os.waitpid(trial, 0)
            end_descendants()  # what the trial left behind
            # The answer to "end", or to another question if the trial ended before it was told to.
            channel.send_reply({"over": _status(os.waitstatus_to_exitcode(status)), "peak_mib": peak_memory_mib(True)})
    except Closed:
        pass
    finally:
        os._exit(0)


def _one_thread() -> None:
    # The threads of the process that learned do not exist in a fork of it.
    torch = sys.modules.get("torch")
    if torch is not None and hasattr(torch, "set_num_threads"):
        torch.set_num_threads(1)


def _hide_gpus(name: str, given: Mapping[str, Any]) -> None:
    """Hides GPUs from a method that is to use none, before its module is imported.

    Where PyTorch sees a GPU, its first gradient starts a thread for it even on a CPU, and then refuses gradients in a
    fork of the process.
    """
    entry = methods().get(name)
    ships = entry is not None and entry.value.startswith("vsfsim.baselines.")  # their device is a cpu if none is given
    if given.get("device", "cpu" if ships else None) == "cpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def _gpus_are_hidden() -> bool:
    return os.environ.get("CUDA_VISIBLE_DEVICES") == ""


def _first_gradient() -> None:
    """Take PyTorch's first gradient before any fork, if GPUs are hidden.

    With it a PyTorch built for CUDA asks the driver for the number of GPUs, also where all are hidden, and keeps the
    answer. Where Warp has started the driver, asking it in a fork ends with SIGSEGV.
    """
    torch = sys.modules.get("torch")
    if torch is not None and _gpus_are_hidden():
        torch.zeros((), requires_grad=True).backward()


def _driver_is_loaded() -> bool:
    """Whether the library of a GPU's driver is loaded here, so that a fork may not use a GPU."""
    try:
        return "libcuda.so" in Path("/proc/self/maps").read_text()
    except OSError:
        return True  # a system that does not tell


def _uses_gpu() -> bool:
    """Whether a GPU's driver is in use here: a fork could not use it."""
    torch, warp = sys.modules.get("torch"), sys.modules.get("warp")
    if torch is not None and torch.cuda.is_initialized():
        return True
    runtime = getattr(getattr(getattr(warp, "_src", warp), "context", None), "runtime", None)
    return any(getattr(device, "has_primary_context", False) for device in getattr(runtime, "cuda_devices", ()) or ())


def _status(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"{name}, as a process that is out of memory is" if -code == signal.SIGKILL else name


def _failure(error: BaseException) -> dict[str, Any]:
    if isinstance(error, MissingPackage):
        return {"error": "missing", "text": str(error)}
    if isinstance(error, VsfsimError):
        return {"error": "refused", "text": str(error)}
    return {"error": "raised", "type": type(error).__name__, "text": str(error)}


def _package(name: str, factory: Any) -> tuple[str, str]:
    """The installed package that a method is from and its version; ("", "") for a file that is not installed."""
    entry = methods().get(name)
    if entry is not None and entry.dist is not None:
        return entry.dist.name, entry.dist.version
    top = str(getattr(factory, "__module__", "")).partition(".")[0]
    for package in metadata.distributions():  # metadata.packages_distributions() would read every list of files
        name = package.metadata["Name"] or ""
        listed = (package.read_text("top_level.txt") or name.replace("-", "_")).split()
        if top in listed:
            return name, package.version
    return "", ""


def _packed(method: Method) -> bytes:
    """What a method has learned, as bytes.

    Raises:
        MethodError: it can neither be pickled nor saved.
    """
    try:
        return b"p" + pickle.dumps(method)
    except Exception as error:
        if not (hasattr(method, "save") and hasattr(method, "load")):
            raise MethodError(f"the method uses a GPU or runs where processes cannot be forked, so that each trial "
                              f"needs a copy of what it learned; but it cannot be pickled ({error}) and has no save() "
                              f"and load(). Give it both, or --set device=cpu.") from error
        with tempfile.TemporaryDirectory() as folder:
            method.save(Path(folder))
            out = io.BytesIO()
            with tarfile.open(fileobj=out, mode="w") as archive:
                archive.add(folder, arcname=".")
        return b"f" + out.getvalue()


def _unpacked(state: bytes, fresh: Any) -> Any:
    if state[:1] == b"p":
        return pickle.loads(state[1:])
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(state[1:])) as archive:
            archive.extractall(folder, filter="data")
        fresh.load(Path(folder))
    return fresh
