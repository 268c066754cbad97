"""Frames a second of a scene on a GPU, what its host asks of it, and what the cores of the same host make of the same
touches: `vsfsim measure gpu`."""

from __future__ import annotations

import os
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.records import ObjectView
from vsfsim.data.verify import compare
from vsfsim.generate.effector import effector_of, kernels_of
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.run import make, planned
from vsfsim.generate.workers import sharing
from vsfsim.physics.runtime import compile_kernels

_LAUNCHES = ("LaunchKernel", "LaunchKernelExC", "GraphLaunch", "MemcpyAsync", "MemsetAsync")
_WAITS = ("StreamSynchronize", "DeviceSynchronize", "EventSynchronize")


def measure(scene: str, *, device: str = "cuda:0", objects: int | None = None, touches: int | None = None,
            workers: int | None = None, cores: int | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """Make a dataset of the scene on a GPU, then on CPU cores, and compare times and forces; then make one object view
    in this process, and count what its host asks of the GPU.

    Args:
        scene: name or path of a scene with ``[touches]``.
        device: Warp device of the GPU.
        objects, touches: counts; None for the scene's.
        workers: processes on the GPU; None for what `generate` takes.
        cores: processes on the CPU; None for one a core, 0 to leave that out.
        progress: called with what is going on.

    Raises:
        VsfsimError: the device is no GPU or is not there, or the scene cannot be made.
    """
    if device == "cpu":
        raise VsfsimError("measure gpu: --device is 'cpu', which is no GPU. Give cuda:0.")
    count = os.cpu_count() or 1 if cores is None else cores
    asked = Request(objects=objects, touches=touches)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for where, processes in ((device, workers or sharing(device)), *([("cpu", count)] if count else [])):
            progress(f"making {scene} on {where} in {processes} processes")
            rows.append(_made(scene, Path(folder, where[:4]), asked.but(device=where, workers=processes)))
        if count:
            rows[0]["ratio"] = rows[0]["rate"] / rows[1]["rate"]
            rows[0]["difference"] = compare(Path(folder, "cuda"), Path(folder, "cpu")).worst
        progress("counting what one process asks of the GPU")
        plan = planned(scene, Path(folder, "one"), asked.but(device=device))
        counted = _counted(jobs_of(plan.recipe, plan.loaded.path, plan.folder)[0], device)
    settings = {"scene": scene, "device": device, "objects": objects, "touches": touches, "workers": workers,
                "cores": count}
    return Measurement.of("gpu", settings, [
        Table(f"{scene}, start of the processes included", (
            Column("device", "device"), Column("workers", "processes", "1"),
            Column("compile", "kernels", "s", form=".0f"), Column("frames", "frames", "1"),
            Column("converged", "converged", "1", "%", ".1f"), Column("seconds", "time", "s", form=".0f"),
            Column("rate", "frames a second", "1/s", form=".1f"), Column("ratio", "times the cores", "1", form=".2f"),
            Column("difference", "worst difference of a force", "1", form=".0e")), rows, name="runs"),
        Table("One object view in one process, by frame of all its touches", (
            Column("touches", "touches", "1"), Column("operations", "operations", "1", form=".0f"),
            Column("waits", "waits of the host", "1", form=".0f"), Column("seconds", "time", "s", form=".3f"),
            Column("busy", "GPU busy", "1", "%", ".0f"), Column("rate", "frames a second", "1/s", form=".1f"),
            Column("bound", "without waits", "1/s", form=".0f")), [counted], name="host")],
        notes=["An operation is a kernel, a copy, a fill or a graph that the host starts; without waits: frames of a "
               "touch a second if the GPU had its work at once"])


def _made(scene: str, out: Path, asked: Request) -> dict[str, Any]:
    """A dataset, and how long it took."""
    plan = planned(scene, out, asked)
    began = time.perf_counter()
    compile_kernels(kernels_of(plan.loaded.sample(0), plan.recipe.tier), asked.device)
    compiled = time.perf_counter()
    data = make(plan).dataset
    seconds = time.perf_counter() - compiled
    assert data is not None
    converged = np.concatenate([touch.converged for view in data for touch in view.touches])
    return {"device": asked.device, "workers": asked.workers, "compile": compiled - began, "frames": len(converged),
            "converged": float(converged.mean()), "seconds": seconds, "rate": len(converged) / seconds}


def _counted(job: Job, device: str) -> dict[str, Any]:
    """What the host asks of a GPU by frame of one object view's touches, whose mesh, factor and kernels are there."""
    effector = effector_of(job.scene())

    def make_view() -> ObjectView:
        view = effector.make_view(job, device=device)
        torch.cuda.synchronize(device)
        return view

    view = make_view()
    began = time.perf_counter()
    make_view()
    seconds = time.perf_counter() - began
    with warnings.catch_warnings(), profile(activities=[ProfilerActivity.CUDA], acc_events=True) as seen:
        warnings.simplefilter("ignore")  # of the profiler itself
        make_view()
    rows, touches, frames = seen.key_averages(), len(view.touches), len(view.touches[0].time)

    def total(names: tuple[str, ...]) -> float:
        return sum(row.count for row in rows if row.key.startswith("cu") and row.key.endswith(names)) / frames

    work = 1e-6 * sum(row.self_device_time_total for row in rows)
    return {"touches": touches, "operations": total(_LAUNCHES), "waits": total(_WAITS), "seconds": seconds / frames,
            "busy": work / seconds, "rate": touches * frames / seconds, "bound": touches * frames / work}
