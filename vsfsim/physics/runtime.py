"""Warp started quietly, and its kernels compiled in one visible step instead of one by one in the middle of a run."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp

from vsfsim.core.errors import VsfsimError

ON_THE_HOST: set[str] = set()
"""Modules of kernels that run on the CPU alone, whatever the device: no compiler of a GPU takes them."""
_THREADS = 4  # that compile modules side by side, as `wp.force_load` takes
real = wp.float64
"""The scalar of elements and contact."""
vec3, mat33 = wp.types.vector(length=3, dtype=real), wp.types.matrix(shape=(3, 3), dtype=real)


def kernel_cache() -> Path:
    """The folder in which Warp keeps compiled kernels."""
    return Path(wp.config.kernel_cache_dir)


@contextlib.contextmanager
def muted(descriptor: int) -> Iterator[None]:
    """Drop what native libraries write straight to a file descriptor, 1 or 2, in which a user's table or JSON goes."""
    kept, sink = os.dup(descriptor), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, descriptor)
        yield
    finally:
        if os.name == "posix":
            ctypes.CDLL(None).fflush(None)  # what C has buffered belongs to the sink, too
        os.dup2(kept, descriptor)
        os.close(kept)
        os.close(sink)


def _start() -> None:
    """No banner, and no warning that there is no GPU: the native library writes that one straight to stderr.

    Raises:
        VsfsimError: the folder for compiled kernels cannot be written.
    """
    try:
        with muted(2), wp.ScopedLogLevel(wp.LOG_ERROR):
            wp.init()
        if not os.access(kernel_cache(), os.W_OK):
            raise PermissionError(f"no right to write into '{kernel_cache()}'")
    except OSError as error:
        raise VsfsimError(f"compiled kernels cannot be kept: {error}. Give a folder that can be written: "
                          f"export WARP_CACHE_PATH=/tmp/warp") from error
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING


_start()


def devices() -> list[str]:
    """The devices of Warp in words: alias, name and memory."""
    return [f"{d.alias} ({d.name}" + (f", {d.total_memory / 2**30:.0f} GiB)" if d.is_cuda else ")")
            for d in wp.get_devices()]


def torch_devices() -> list[str]:
    """The devices of torch in words."""
    import torch

    return ["cpu", *(f"cuda:{k} ({torch.cuda.get_device_name(k)})" for k in range(torch.cuda.device_count()))]


def check_device(device: str) -> None:
    """Raises:
        VsfsimError: this machine has no such Warp device, or its Warp cannot compile for the CPU.
    """
    if device == "cpu" and not wp.is_cpu_available():
        raise VsfsimError("the installed Warp has no compiler for the CPU (its library warp-clang is missing, as in a "
                          "build for GPUs only). Install the package from the index, `pip install --force-reinstall "
                          "warp-lang`, or give --device cuda:0.")
    names = [str(d.alias) for d in wp.get_devices()]
    if device not in names:
        raise VsfsimError(f"--device is '{device}', but this machine has {', '.join(names)}. Choose one of them.")


def compile_kernels(kernels: list[Any], device: str, *,
                    progress: Callable[[int, int, str], None] | None = None) -> None:
    """Load the modules of ``kernels`` on ``device``, compiling what is not in Warp's cache (seconds each, then kept).

    Args:
        progress: called with (modules done, modules, name of the next one).

    Raises:
        VsfsimError: as `check_device`.
    """
    check_device(str(wp.get_device(device).alias) if device == "cuda" else device)
    where = wp.get_device(device)
    modules = list({kernel.module.name: kernel.module for kernel in kernels
                    if where.is_cpu or kernel.module.name not in ON_THE_HOST}.values())
    # on a CPU Warp launches blocks of one thread, and keeps a module for each size of block that it met
    load = functools.partial(wp.Module.load, device=where, block_dim=1 if where.is_cpu else None)
    with ThreadPoolExecutor(_THREADS) as pool:
        for done, (module, loaded) in enumerate(zip(modules, [pool.submit(load, m) for m in modules], strict=True)):
            if progress is not None:
                short = module.name.rpartition(".")[2].removeprefix("vsfsim_").split("__")[0]
                progress(done, len(modules), f"kernel modules compiled or found, now {short}")
            loaded.result()
    if progress is not None:
        progress(len(modules), len(modules), "kernel modules ready")


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """``count`` threads in PyTorch until the block ends."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
