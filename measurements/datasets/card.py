"""Frames a second of a scene on a GPU, how busy it is, what it could do, and what CPU cores make of the same:
`vsfsim measure gpu`."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from measurements.datasets.hot_kernels import hot_kernels, kernel_table
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.checks.same import compare
from vsfsim.generate.effector import kernels_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.run import generate
from vsfsim.generate.workers import sharing
from vsfsim.physics.runtime import compile_kernels

_SAMPLE = 100  # milliseconds between two looks at the GPU
_ASKED = "utilization.gpu,memory.used"


def measure(scene: str, *, device: str = "cuda:0", objects: int | None = None, touches: int | None = None,
            workers: int | None = None, cores: int | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """Make a dataset of the scene on a GPU, then on CPU cores, and compare times and forces; under a rigid probe, with
    the hot kernels and the limit that they set.

    Args:
        scene: name or path.
        device: Warp device of the GPU.
        objects, touches: counts; None for the scene's.
        workers: processes on the GPU; None for what `generate` takes.
        cores: processes on the CPU; None for one a core, 0 to leave that out.
        progress: called with what is going on.

    Raises:
        VsfsimError: there is no such GPU, or the scene cannot be made.
    """
    if device == "cpu":
        raise VsfsimError("measure gpu: --device is 'cpu', which is no GPU. Give cuda:0.")
    loaded = load_scene(find_scene(scene))
    recipe: dict[str, Any] = {"objects": objects, "touches": touches}
    made = make_recipe(loaded, device=device, **recipe)
    kernels = kernels_of(loaded.sample(0))
    count = os.cpu_count() or 1 if cores is None else cores
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for where, processes in ((device, workers or sharing(device)), *([("cpu", count)] if count else [])):
            progress(f"compiling kernels for {where}, or finding them")
            began = time.perf_counter()
            compile_kernels(kernels, where)
            row: dict[str, Any] = {"device": where, "compile": time.perf_counter() - began, "workers": processes}
            progress(f"making the scene on {where}")
            rows.append({**row, **_made(loaded, Path(folder, where[:4]), where, processes, recipe)})
        progress("timing its hot kernels")
        hot, rows[0]["limit"] = hot_kernels(loaded, made, device)
        if count:
            rows[0]["ratio"] = rows[0]["rate"] / rows[1]["rate"]
            rows[0]["difference"] = compare(Path(folder, "cuda"), Path(folder, "cpu")).worst
    service = Path(os.environ.get("CUDA_MPS_PIPE_DIRECTORY", "/tmp/nvidia-mps"), "control").exists()
    note = (f"The multi-process service (nvidia-cuda-mps-control -d) was {'' if service else 'not '}there: without "
            "it kernels of one process wait for those of another")
    settings = {"scene": scene, "device": device, **recipe, "workers": workers, "cores": count}
    return Measurement.of("gpu", settings, [Table(f"{scene}, start of the processes included", (
        Column("device", "device"), Column("workers", "processes", "1"),
        Column("compile", "kernels", "s", form=".0f"), Column("frames", "frames", "1"),
        Column("converged", "converged", "1", "%", ".1f"), Column("seconds", "time", "s", form=".0f"),
        Column("rate", "frames a second", "1/s", form=".1f"), Column("busy", "GPU busy", "1", "%", ".0f"),
        Column("memory", "its memory", "B", "GB", ".1f"), Column("ratio", "times the cores", "1", form=".2f"),
        Column("difference", "worst difference of a force", "1", form=".0e"),
        Column("limit", "limit, frames a second", "1/s", form=".0f")), rows, name="runs"),
        *kernel_table(hot)], notes=[note])


def _made(loaded: SceneFile, out: Path, device: str, workers: int | None,
          recipe: dict[str, Any]) -> dict[str, Any]:
    """Frames, their rate and the GPU's load while a dataset is made."""
    with _watched(device) as seen:
        began = time.perf_counter()
        data = generate(loaded, out, device=device, workers=workers, **recipe)
        seconds = time.perf_counter() - began
    converged = [touch.converged for view in data for touch in view.touches]
    frames = sum(len(c) for c in converged)
    load = [tuple(map(float, line.split(","))) for line in seen if line.strip()]
    return {"frames": frames, "converged": sum(int(c.sum()) for c in converged) / frames, "seconds": seconds,
            "rate": frames / seconds, "busy": 0.01 * sum(u for u, _ in load) / len(load) if load else None,
            "memory": 2.0**20 * max(m for _, m in load) if load else None}


@contextlib.contextmanager
def _watched(device: str) -> Iterator[list[str]]:
    """What nvidia-smi, if it is there, says of a GPU in the meantime: lines that are there at the end."""
    seen: list[str] = []
    if device == "cpu" or shutil.which("nvidia-smi") is None:
        yield seen
        return
    import torch

    card = f"GPU-{torch.cuda.get_device_properties(device).uuid}"
    command = ["nvidia-smi", "-i", card, f"--query-gpu={_ASKED}", "--format=csv,noheader,nounits", f"-lms={_SAMPLE}"]
    with tempfile.TemporaryFile("w+") as log, subprocess.Popen(command, stdout=log) as watch:
        try:
            yield seen
        finally:
            watch.terminate()
            watch.wait()
            log.seek(0)
            seen += log.readlines()
