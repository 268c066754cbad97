"""What a GPU's time on solids goes to: the two products of a conjugate gradient, beside what the GPU could do.

An iteration of a batch of k touches multiplies by the inverse at rest, A (3 n, 3 n), and by the tangents of m ten-node
tetrahedra. The limit is the frames a second of a GPU that does nothing else and reaches, in each, the bandwidth that it
has in a copy or the arithmetic that it has in a product of large matrices, whichever is less. A frame takes as many
iterations as its slowest touch.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import torch
import warp as wp

from measurements.measurement import Column, Table
from vsfsim.core.scene import SceneFile
from vsfsim.data.recipe import Recipe
from vsfsim.generate.effector import effector_of
from vsfsim.generate.effectors.probe import EFFECTOR
from vsfsim.generate.job import jobs_of
from vsfsim.generate.solid import prepare
from vsfsim.physics.linear.rest_factor import DENSE
from vsfsim.physics.model import Model
from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.touches import Solver

_OPERATIONS = 2800
"""Of a ten-node tetrahedron's tangent times a vector: at each of four points two gradients of ten nodes (2 x 180), the
law (162), its stress at the element's vertices (54) and the forces of that on ten nodes (about 120)."""
_REPEATS, _WARM_UP, _TOGETHER = 10, 2, 8  # samples; those before them; calls of each
_COPIED, _SQUARE = {"cpu": 1 << 18, "cuda": 1 << 28}, {"cpu": 128, "cuda": 8192}  # doubles copied; size of matrices


def hot_kernels(loaded: SceneFile, recipe: Recipe, device: str) -> tuple[list[dict[str, Any]], float | None]:
    """Both products for the touches of the first view of a scene with a rigid probe, and the limit [frames/s];
    neither under another effector, without conjugate gradients, or where the solver has no dense inverse (`DENSE`).

    Args:
        loaded: the scene.
        recipe: what is made of it.
        device: Warp device.

    Returns:
        Rows with ``kernel``, ``seconds`` of one [s], ``share`` of the time of both in the iterations of the view,
        ``bandwidth`` and ``arithmetic``, each over what the device reaches; and the limit.
    """
    if effector_of(loaded.sample(0)) is not EFFECTOR:
        return [], None
    with tempfile.TemporaryDirectory() as folder, _counted() as counted:
        job = jobs_of(recipe, loaded.path, folder, None)[0]
        subject = prepare(job, device=device)
        EFFECTOR.touch(subject, EFFECTOR.aim(subject, device=device), device=device)
    frames = sum(cg.size for cg in counted)
    iterations = sum(int(cg.max(axis=1).sum()) for cg in counted)
    if not iterations or len(subject.model.free) > DENSE:
        return [], None
    rows = _products(subject.model, counted[0].shape[1], device)
    limit = sum(max(row["moved"], row["computed"]) for row in rows)
    both = sum(row["seconds"] for row in rows)
    return [{"kernel": row["kernel"], "seconds": row["seconds"], "share": row["seconds"] / both,
             "bandwidth": row["moved"] / row["seconds"], "arithmetic": row["computed"] / row["seconds"]}
            for row in rows], frames / (iterations * limit)


def kernel_table(rows: list[dict[str, Any]]) -> list[Table]:
    """The table of the rows of `hot_kernels`; none without any."""
    columns = (Column("kernel", "product"), Column("seconds", "time", "s", "ms", ".3f"),
               Column("share", "of both", "1", "%", ".0f"),
               Column("bandwidth", "of a copy's bandwidth", "1", "%", ".0f"),
               Column("arithmetic", "of a matrix product's arithmetic", "1", "%", ".0f"))
    title = "The products of a conjugate gradient, in one process"
    return [Table(title, columns, rows, name="kernels")] if rows else []


@contextmanager
def _counted() -> Iterator[list[np.ndarray]]:
    """The conjugate gradients (T, B) of every batch that is solved in the meantime."""
    out: list[np.ndarray] = []
    own = Solver.run

    def run(self: Solver, *args: Any, **named: Any) -> Any:
        frames = own(self, *args, **named)
        out.append(frames.cg_iterations)
        return frames

    with mock.patch.object(Solver, "run", run):
        yield out


def _products(model: Model, touches: int, device: str) -> list[dict[str, Any]]:
    """Time of each product for so many touches [s], and that of its bytes and operations at the device's best [s]."""
    kind, size = device.split(":")[0], len(model.free)
    inverse = model.preconditioner.dense(device, exact=False)
    x = torch.rand((size, touches), dtype=torch.float64, device=device)
    short, out = x.to(inverse.dtype), torch.empty_like(x)
    elasticity = Elasticity(model, device=device)
    elasticity.begin(touches)
    index = wp.array(np.arange(touches), dtype=wp.int32, device=device)
    given, back = wp.from_torch(x), wp.from_torch(out)
    elasticity.tangent(index, wp.zeros_like(given), projected=True)
    copied = torch.rand(_COPIED[kind], dtype=torch.float64, device=device)
    bandwidth = 2.0 * copied.nbytes / _seconds(copied.clone, device)
    elements = sum(len(block) for block in model.blocks if block.kind == "tet10")
    read = sum(block.nodes.nbytes + sum(np.asarray(a).nbytes for a in block.parameters.values())
               + 8 * block.element.state_size(block) * len(block) * touches for block in model.blocks)
    return [
        {"kernel": f"inverse at rest, {size} unknowns, {touches} columns",
         "seconds": _seconds(lambda: inverse @ short, device), "moved": (inverse.nbytes + 2 * short.nbytes) / bandwidth,
         "computed": 2.0 * size**2 * touches / _rate(inverse.dtype, device)},
        {"kernel": f"tangents of {elements} tetrahedra, {touches} columns",
         "seconds": _seconds(lambda: elasticity.multiply(index, given, back), device),
         "moved": (read + 3 * x.nbytes) / bandwidth,
         "computed": _OPERATIONS * elements * touches / _rate(torch.float64, device)}]


def _rate(real: torch.dtype, device: str) -> float:
    """Operations a second in a product of large matrices."""
    n = _SQUARE[device.split(":")[0]]
    some = torch.rand((n, n), dtype=real, device=device)
    return 2.0 * n**3 / _seconds(lambda: some @ some, device)


def _seconds(call: Callable[[], object], device: str) -> float:
    """Median duration of a call [s]."""
    wait = torch.cuda.synchronize if device != "cpu" else lambda: None
    spent = []
    for _ in range(_WARM_UP + _REPEATS):
        wait()
        began = time.perf_counter()
        for _ in range(_TOGETHER):
            call()
        wait()
        spent.append((time.perf_counter() - began) / _TOGETHER)
    return float(np.median(spent[_WARM_UP:]))
