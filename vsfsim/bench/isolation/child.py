"""A process of a method's: one that looks at it, one in which it learns, or one for a trial.

`vsfsim.bench.isolation.host` forks it into a container. What the method learned leaves the process as bytes (the
pickled method, or the files of its `save`, and what it put into its caches), and each trial begins with these bytes
and with nothing else.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import pickle
import sys
import tempfile
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.isolation.wire import Reply, encoded, files_in, packed, receive_request, unpacked, write_files
from vsfsim.bench.method import (
    Method,
    build_method,
    checked_choice,
    checked_prediction,
    find_method,
    parameters_of,
    plain_parameters,
)
from vsfsim.core.errors import MethodError, VsfsimError
from vsfsim.core.extras import MissingPackage
from vsfsim.core.plain_text import plain

OPTIONAL = ("predict_std", "stiffness", "locate", "choose")
"""Functions of a method that the scorer asks for where they exist."""


def main(line: Connection) -> None:
    """Answer requests until the scorer closes the line."""
    server = _Server()
    sys.addaudithook(server.watch)
    with contextlib.suppress(EOFError, OSError):
        while True:
            operation, payload = receive_request(line)
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
        self.view: Any = None
        self.support: list[Any] = []
        self.opened = set[str]()

    def watch(self, event: str, operands: tuple[Any, ...]) -> None:
        """The audit hook: keep the name of every file that is opened to be read."""
        if event == "open" and isinstance(operands[0], str) and operands[1] in (None, "r", "rb", "rt"):
            self.opened.add(os.path.abspath(operands[0]))

    # ------------------------------------------------------------------ before the trials

    def do_find(self, payload: dict[str, Any]) -> Reply:
        self.factory = find_method(payload["name"], search=payload["folder"])
        self.parameters = parameters_of(self.factory, payload["parameters"])
        plain_parameters(self.parameters)
        return Reply({"entry": f"{self.factory.__module__}:{getattr(self.factory, '__qualname__', self.factory)}",
                      "parameters": self.parameters, "seeded": "seed" in inspect.signature(self.factory).parameters})

    def do_check(self, name: str) -> Reply:
        from vsfsim.bench.check import check  # half of what a process would import that is not asked to check

        findings = check(name, parameters=self.parameters, brief=True)
        # where one fails, the next would fail for the same reason
        return Reply({"failed": [[f.clause, f.detail] for f in findings if f.outcome == "failed"][:1]})

    def do_build(self, seed: int | None) -> None:
        self.method = self.build(seed)

    def build(self, seed: int | None) -> Method:
        return build_method(self.factory, {**self.parameters, **({} if seed is None else {"seed": seed})})

    def do_meta_fit(self, specimens: Any) -> None:
        _use_threads(int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1))
        self.method.meta_fit(specimens)

    def do_state(self, _: Any) -> Reply:
        return Reply({"host": getattr(self.method, "trials_on_host", False) is True, "opened": sorted(self.opened)},
                     blob=pickle.dumps((packed(self.method), files_in(Path(os.environ["XDG_CACHE_HOME"])))))

    def do_restore(self, payload: Any) -> None:
        seed, state = payload
        learned, cached = pickle.loads(state)
        write_files(cached, Path(os.environ["XDG_CACHE_HOME"]))
        self.method = unpacked(learned, lambda: self.build(seed))
        _use_threads(1)

    # ------------------------------------------------------------------ one trial

    def do_object(self, payload: Any) -> None:
        self.view, self.support = payload

    def do_adapt(self, _: Any) -> Reply:
        self.method.adapt(self.view, self.support)
        return Reply({"offers": [name for name in OPTIONAL if callable(getattr(self.method, name, None))]})

    def do_choose(self, offered: Any) -> Reply:
        chosen = checked_choice(self.method.choose(self.view, list(self.support), offered), len(offered))
        return Reply(arrays=(np.array([float(chosen)]),))

    def do_made(self, reading: Any) -> None:
        self.support = [*self.support, reading]

    def do_predict(self, payload: Any, function: str = "predict") -> Reply:
        actions, names = payload
        return Reply(arrays=tuple(checked_prediction(getattr(self.method, function)(actions), actions, names)))

    def do_predict_std(self, payload: Any) -> Reply:
        return self.do_predict(payload, "predict_std")

    def do_stiffness(self, points: np.ndarray) -> Reply:
        given = self.method.stiffness(points)
        if getattr(given, "mean", None) is None:
            raise MethodError(f"stiffness must return an Estimate with a mean and a std; it returned "
                              f"{type(given).__name__}.")
        return Reply(arrays=tuple(_numbers(value, f"stiffness has a {key}") for key, value in (
            ("mean", given.mean), ("std", getattr(given, "std", None)))))

    def do_locate(self, payload: Any) -> Reply:
        return Reply(arrays=(_numbers(self.method.locate(*payload), "locate must return a transform (4, 4), and not "
                                                                    "one"),))


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


def _numbers(value: Any, what: str) -> np.ndarray:
    """``value`` as float64, empty for None."""
    try:
        return np.zeros(0) if value is None else np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{what} that is not an array of real numbers: {error}.") from error


def _failure(error: BaseException) -> Reply:
    kind = "missing" if isinstance(error, MissingPackage) else "refused" if isinstance(error, VsfsimError) else "raised"
    return Reply({"error": kind, "type": plain(type(error).__name__), "text": plain(error)})
