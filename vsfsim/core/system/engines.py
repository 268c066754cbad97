"""Engines that make the parts of a work on other machines: a Ray cluster, on which each item is a task; Slurm and
Kubernetes, whose tasks are the shards of a command; which shard this process makes, and processes of one thread. None
of the engines is needed for one machine.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.errors import VsfsimError
from vsfsim.core.extras import require

MOST = 100_000
"""Shards of one work."""


@dataclass(frozen=True)
class Fan:
    """The default is this machine, by itself."""

    shard: tuple[int, int] | None = None
    """(i, n): only the i-th of n shares of the parts, from 0; whoever runs the work without it ends it."""
    ray: str = ""
    """Address of a Ray cluster that makes the parts; "" for none."""
    gpus: float = 0.0
    """GPUs of each of its tasks [1]."""


HERE = Fan()


def shard_of(given: str, environment: Mapping[str, str] | None = None) -> tuple[int, int]:
    """(i, n) of ``--shard``: the i-th of n shards, from 0.

    Args:
        given: "i/n"; "auto" for index and number of a Slurm job array; "auto/n" for the index of an array or of a
            Kubernetes Indexed Job, which does not tell its number.
        environment: of the process, None for this one's.

    Raises:
        VsfsimError: another text, i is not below n, or the environment says nothing.
    """
    env = os.environ if environment is None else environment
    index, _, count = given.partition("/")
    try:
        if index == "auto":
            first = int(env.get("SLURM_ARRAY_TASK_MIN", "0"))
            index = str(int(env["SLURM_ARRAY_TASK_ID"]) - first) if "SLURM_ARRAY_TASK_ID" in env else env[
                "JOB_COMPLETION_INDEX"]
            count = count or env["SLURM_ARRAY_TASK_COUNT"]
        if 0 <= int(index) < int(count) <= MOST:
            return int(index), int(count)
        why = ""
    except KeyError as name:
        why = f", but {name} is not set: this is no task of a job array, or it does not say how many there are"
    except ValueError as wrong:
        why = f": {wrong}"
    raise VsfsimError(f"--shard is '{given}', of '{index}' and '{count}'{why}. Allowed: i/n with 0 <= i < n, e.g. 0/4 "
                      f"to 3/4; auto in a Slurm job array; auto/n there or in a Kubernetes Indexed Job.")


MOST_TASKS = 1000
"""Tasks of a Slurm array; `MaxArraySize` is 1001 on many clusters."""


def job_file(engine: str, words: Sequence[str], shards: int, *, gpus: int = 0) -> str:
    """The file for `sbatch` or `kubectl apply -f`.

    Args:
        engine: "slurm" or "k8s". words: the command and its options. shards: tasks. gpus: of each task.

    Raises:
        VsfsimError: too many shards, a word with a control character, or for Kubernetes a path of this machine.
    """
    odd = [word for word in words if not word.isprintable()]
    if odd:
        raise VsfsimError(f"{odd[0]!r} has a character that ends a line of a job's file. Rename what it names.")
    if engine == "slurm" and shards > MOST_TASKS:
        raise VsfsimError(f"--shards is {shards}; a Slurm array has at most {MOST_TASKS} tasks on many clusters. "
                          f"Give fewer: a shard makes several views.")
    here = [word for word in words if os.path.isabs(word.partition("=")[2] or word) or word.startswith("~")]
    if engine == "k8s" and here:
        raise VsfsimError(f"'{here[0]}' is a path of this machine, which a pod does not have. Give the address of an "
                          f"object store (s3://...), or a path in the volume of the claim 'vsfsim', relative to it: "
                          f"pods work in that folder.")
    import jinja2  # not needed on one machine

    command = shlex.join(words)
    text = Path(__file__).with_name({"slurm": "slurm.sh", "k8s": "k8s.yaml"}[engine]).read_text(encoding="utf-8")
    return jinja2.Template(text, trim_blocks=True, keep_trailing_newline=True).render(
        command=command, words=[*words], shards=shards, gpus=gpus,
        # a name is a DNS label: small letters, digits and dashes, 63 at most; another command is another job
        name=f"vsfsim-{hashlib.sha256(command.encode()).hexdigest()[:10]}")


WAIT = 5.0  # a cluster may take so long to answer [s]


def on_ray(function: Callable[[Any], None], items: Sequence[Any], *, address: str = "auto", gpus: float = 0.0,
           retries: int = 20) -> Iterator[tuple[int, str]]:
    """Call ``function(item)`` for each item on a cluster; yields (number of the item, "" or its error) as they end.

    No more tasks than twice the cluster's cores wait at a time. A task whose process or node dies is started again.

    Args:
        function: importable on the cluster's machines. items: what can be pickled. address: of the cluster, "auto" for
        that of this machine. gpus: of each task. retries: of a task whose process dies.

    Raises:
        VsfsimError: no such cluster, no such GPU, or it was lost. MissingPackage: Ray is not installed.
    """
    require("ray", "ray")
    import ray

    try:
        head = _connect(ray, address)
        if gpus and (there := ray.cluster_resources().get("GPU", 0.0)) < gpus:
            raise VsfsimError(f"--gpus-per-task is {gpus:g}, but the Ray cluster has {there:g} GPUs.")
        # Ray takes a function, and no `functools.partial`
        task: Any = ray.remote(lambda item: function(item)).options(
            name="vsfsim", num_cpus=1, num_gpus=gpus, max_retries=retries, runtime_env={"env_vars": ONE_THREAD})
        going: dict[Any, int] = {}
        todo = list(range(len(items)))
        while todo or going:
            room = max(2, 2 * int(ray.cluster_resources().get("CPU", 1)))
            while todo and len(going) < room:
                number = todo.pop(0)
                going[task.remote(items[number])] = number
            for ready in ray.wait(list(going), num_returns=1, timeout=WAIT)[0]:
                yield going.pop(ready), _error(ray, ready)
            _reach(head)  # Ray itself waits a minute for a head that is gone, and then ends this process
    except (ray.exceptions.RaySystemError, OSError) as error:
        raise VsfsimError(f"the Ray cluster at '{address}' was lost: {error}. What is finished is kept; start it and "
                          f"run the same command again.") from error
    finally:
        with contextlib.suppress(Exception):
            ray.shutdown()


def _connect(ray: Any, address: str) -> str:
    where = os.environ.get("RAY_ADDRESS", "auto") if address == "auto" else address
    try:
        if ":" in where.removeprefix("ray://"):
            _reach(where)
        ray.init(address=where, log_to_driver=False, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError) as error:
        raise VsfsimError(f"there is no Ray cluster at '{where}': {str(error).partition(chr(10))[0]} Start one with "
                          f"`ray start --head`, or give --address HOST:PORT of its head.") from None
    return where if "://" in where else str(ray.get_runtime_context().gcs_address)


def _reach(head: str) -> None:
    host, _, port = head.removeprefix("ray://").rpartition(":")
    socket.create_connection((host, int(port)), timeout=WAIT).close()


def _error(ray: Any, ready: Any) -> str:
    try:
        ray.get(ready)
    except ray.exceptions.RayTaskError as error:
        return str(error.cause if isinstance(error.cause, VsfsimError) else error)
    except ray.exceptions.RayError as error:
        return f"its process died on the cluster again and again: {type(error).__name__}"
    return ""


ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a process of one thread."""


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Processes that start in the block have one thread each, because a sum that is split over threads depends on how
    many there are."""
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name in ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)
