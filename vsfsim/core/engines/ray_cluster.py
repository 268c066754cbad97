"""Ray: one remote task an item, on a cluster that is there already."""
from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from vsfsim.core.errors import VsfsimError
from vsfsim.core.extras import missing_package
from vsfsim.core.system.threads import ONE_THREAD

WAIT = 5.0  # a cluster may take so long to answer [s]


def run(function: Callable[[Any], None], items: Sequence[Any], *, address: str = "auto", gpus: float = 0.0,
        retries: int = 20) -> Iterator[tuple[int, str]]:
    """Call ``function(item)`` for each item on a cluster; yields (number of the item, "" or its error) as they end.

    No more tasks than twice the cluster's cores wait at a time. A task whose process or node dies is started again.

    Args:
        function: importable on the cluster's machines. items: what can be pickled. address: of the cluster, "auto" for
        that of this machine. gpus: of each task. retries: of a task whose process dies.

    Raises:
        VsfsimError: no such cluster, no such GPU, or it was lost. MissingPackage: Ray is not installed.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise missing_package("ray", "ray") from None
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
