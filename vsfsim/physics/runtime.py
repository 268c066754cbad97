"""Warp started quietly, and its kernels compiled in one visible step instead of one by one in the middle of a run."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import warp as wp


def _start() -> None:
    """No banner, and no warning that there is no GPU: the native library writes that one straight to stderr."""
    kept, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        with wp.ScopedLogLevel(wp.LOG_ERROR):
            wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(sink)
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING


_start()


def compile_kernels(kernels: list[Any], device: str, *,
                    progress: Callable[[int, int, str], None] | None = None) -> None:
    """Load the modules of ``kernels`` on ``device``, compiling what is not in Warp's cache (seconds each, then kept).

    Args:
        progress: called with (modules done, modules, name of the next one).
    """
    modules = list({kernel.module.name: kernel.module for kernel in kernels}.values())
    for done, module in enumerate(modules):
        if progress is not None:
            short = module.name.rpartition(".")[2].removeprefix("vsfsim_").split("__")[0]
            progress(done, len(modules), f"kernel modules compiled or found, now {short}")
        module.load(wp.get_device(device))
    if progress is not None:
        progress(len(modules), len(modules), "kernel modules ready")
