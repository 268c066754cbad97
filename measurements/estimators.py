"""Time and memory of every estimator beside its literal dense form, at equal answers: `vsfsim measure methods`.

The literal forms are the papers' equations written with dense matrices over the touched particles, as openvsf has them:
eq. 15 with W B Sigma B^T W^T + Sigma_Z, its inverse and automatic differentiation; eq. 16 as one dense least squares
problem with bounds; the diagonal Kalman filter with a dense gain. Each runs in a process of its own, so that its peak
memory is its own. What takes less than some seconds runs again, and the fastest run counts. On a CPU the processor's
time is compared, because other programs on the machine do not change it; the time on the clock stands beside it. Where
a literal form would not fit, or would take minutes, both forms run on as many of the workload's touches as it can take,
and its time for the whole is estimated from its number of operations.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from measurements.measurement import Column, Measurement, Progress, Table
from measurements.workload import MEAN, NOISE, STD, Workload
from vsfsim.core.system.process_memory import held_memory, peak_memory
from vsfsim.vsf.estimate.kalman import DiagonalFilter
from vsfsim.vsf.estimate.map import map_estimate

MOST_BYTES = 4e9
"""Size of the dense matrices [B] beyond which a literal form does not run: it would swap, or end the process."""
MOST_WORK = 3e12
"""Number of operations beyond which it does not run: some minutes of one core."""
MINI, PAPER = (2000, 100, 20), (20_000, 60, 15)
"""(particles, touches, frames): 2,000 readings of 2,000 particles; 900 frames of 20,000 particles (the paper's)."""
_SHORT, _REPEATS = 3.0, 5  # runs shorter than the first [s] are repeated, at most this often


class Times(NamedTuple):
    """Of the fastest run."""

    clock: float
    """On the clock [s]."""
    busy: float
    """Of the processor, all threads together [s]."""


@dataclass(frozen=True)
class Estimator:
    """One estimator in both forms."""

    name: str
    """For the table."""
    ours: Callable[[Workload, str], tuple[Times, np.ndarray]]
    """(workload, device) -> (time, answer)."""
    literal: Callable[[Workload, str], tuple[Times, np.ndarray]]
    """The same by the literal form."""
    matrix: str
    """Field of the workload that it reads."""
    needs: Callable[[float, float, float, float], tuple[float, float]]
    """(rows, touched particles, particles moved at once, rows of a frame) -> bytes [B] and operations [-] of the
    literal form."""

    def cost(self, load: Workload) -> tuple[float, float]:
        """Bytes and operations of the literal form on a workload."""
        w = getattr(load, self.matrix)
        touched = len(np.unique(w.indices))
        return self.needs(float(w.shape[0]), float(touched), w.nnz / 9.0 / max(len(load.pressure_z), 1),
                          float(load.frame))


def epoch(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """Eq. 15 of one object, value and gradient, after a reduction that is made once for all epochs: (time of an epoch,
    answer)."""
    import torch

    from vsfsim.vsf.estimate.evidence import Evidence

    evidence = Evidence.of(load.pressure, load.pressure_z, noise_std=NOISE, touch=load.touch, device=device)
    mean, var = (torch.full((len(evidence.touched),), x, dtype=torch.float64, device=device, requires_grad=True)
                 for x in (MEAN, STD**2))

    def work() -> np.ndarray:
        value = evidence.nll(mean, var)
        return np.concatenate([[value.item()], *(g.cpu().numpy() for g in torch.autograd.grad(value, [mean, var]))])

    return _timed(work)


def epoch_literal(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """The same with dense matrices and automatic differentiation."""
    import torch

    touched = np.unique(load.pressure.indices)
    w = torch.tensor(load.pressure[:, touched].toarray(), device=device)
    z = torch.tensor(load.pressure_z, device=device)
    mean, var = (torch.full((len(touched),), x, dtype=torch.float64, device=device, requires_grad=True)
                 for x in (MEAN, STD**2))

    def work() -> np.ndarray:
        spread = w @ torch.diag(var) @ w.T + NOISE**2 * torch.eye(len(z), dtype=torch.float64, device=device)
        e = z - w @ mean
        value = (0.5 * e @ torch.linalg.inv(spread) @ e + 0.5 * torch.slogdet(spread)[1] + 0.5 * len(z)
                 * np.log(2.0 * np.pi))
        return np.concatenate([[value.item()], *(g.cpu().numpy() for g in torch.autograd.grad(value, [mean, var]))])

    return _timed(work)


def batch(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """Eq. 16 from pressures."""
    return _timed(lambda: map_estimate(load.pressure, load.pressure_z, noise_std=NOISE, prior_mean=MEAN,
                                       prior_var=STD**2).mean)


def batch_literal(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """Eq. 16 as one dense bounded least squares problem, [W / s; 1 / v] K = [z / s; mu / v], by Lawson and Hanson's
    active set."""
    touched = np.unique(load.pressure.indices)
    n = len(touched)

    def solve() -> np.ndarray:
        a = np.concatenate([load.pressure[:, touched].toarray() / NOISE, np.eye(n) / STD])
        out = np.full(load.pressure.shape[1], MEAN)
        out[touched] = optimize.nnls(a, np.concatenate([load.pressure_z / NOISE, np.full(n, MEAN / STD)]),
                                     maxiter=100 * n)[0]
        return out

    return _timed(solve)


def batch_dense(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """Eq. 16 from contact forces on the vertices."""
    return _timed(lambda: map_estimate(load.dense, load.dense_z, noise_std=NOISE, prior_mean=MEAN,
                                       prior_var=STD**2).mean)


def batch_dense_literal(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """The same as a dense problem; its normal matrix is formed, as any QP solver would be given it."""
    touched = np.unique(load.dense.indices)

    def solve() -> np.ndarray:
        w = load.dense[:, touched].toarray() / NOISE
        hessian = w.T @ w + np.eye(w.shape[1]) / STD**2
        factor = np.linalg.cholesky(hessian)
        right = np.linalg.solve(factor, w.T @ (load.dense_z / NOISE) + MEAN / STD**2)
        out = np.full(load.dense.shape[1], MEAN)
        out[touched] = optimize.nnls(factor.T, right, maxiter=100 * w.shape[1])[0]
        return out

    return _timed(solve)


def online(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """The diagonal Kalman filter on contact forces, frame by frame."""
    def work() -> np.ndarray:
        state = DiagonalFilter.start(load.dense.shape[1], mean=MEAN, var=STD**2)
        state.run(load.dense, load.dense_z, noise_std=NOISE, size=load.frame)
        return np.concatenate([state.mean, state.var])

    return _timed(work)


def online_literal(load: Workload, device: str = "cpu") -> tuple[Times, np.ndarray]:
    """The same with a gain over the particles that a frame moves and all vertices."""
    def work() -> np.ndarray:
        mean, var = np.full(load.dense.shape[1], MEAN), np.full(load.dense.shape[1], STD**2)
        for first in range(0, load.dense.shape[0], load.frame):
            part, z = load.dense[first:first + load.frame], load.dense_z[first:first + load.frame]
            moved = np.unique(part.indices)
            if len(moved) == 0:
                continue
            w = part[:, moved].toarray()
            gain = (var[moved, None] * w.T) @ np.linalg.inv((w * var[moved]) @ w.T + NOISE**2 * np.eye(len(z)))
            mean[moved] = np.maximum(mean[moved] + gain @ (z - w @ mean[moved]), 0.0)
            var[moved] -= np.einsum("nm,mn->n", gain, w * var[moved])
        return np.concatenate([mean, var])

    return _timed(work)


# Bytes and operations: m rows, n touched particles, k moved in a frame, r rows of a frame.
ESTIMATORS = (
    Estimator("eq. 15, value and gradient", epoch, epoch_literal, "pressure",
              lambda m, n, k, r: (8.0 * (4 * m * n + 6 * m * m + 3 * n * n),
                                  6.0 * (m * n * n + m * m * n) + 12.0 * m**3)),
    Estimator("eq. 16 from pressure", batch, batch_literal, "pressure",
              lambda m, n, k, r: (16.0 * (m + n) * n, 12.0 * (m + n) * n * n)),
    Estimator("eq. 16 from contact forces", batch_dense, batch_dense_literal, "dense",
              lambda m, n, k, r: (16.0 * m * n + 24.0 * n * n, 2.0 * m * n * n + 25.0 * n**3)),
    Estimator("diagonal filter", online, online_literal, "dense",
              lambda m, n, k, r: (16.0 * r * (k + r), m / r * (4.0 * r * r * k + 2.0 * r**3))))


@dataclass(frozen=True)
class Comparison:
    """One estimator on one workload."""

    name: str
    """Of the estimator."""
    rows: int
    """Rows of its matrix [-]."""
    particles: int
    """Touched particles [-]."""
    time: Times
    """Time of ours."""
    mib: float
    """Memory of ours [MiB]."""
    part: int
    """Touches that both forms ran on for the comparison: all where the literal form takes them, 0 without one [-]."""
    ours_on_part: Times
    """Time of ours there."""
    literal: Times
    """Time of the literal form there."""
    literal_mib: float
    """Its memory there [MiB]."""
    times: float
    """Literal over ours there [-]."""
    difference: float
    """Of the answers, over the largest value [-]."""
    literal_bytes: float
    """Memory that the literal form would take on the whole [B]."""
    literal_whole: float
    """Time that it would take, from its number of operations [s]."""


def compare(load: Workload, *, literal: bool = True, device: str = "cpu",
            progress: Progress = lambda _: None) -> list[Comparison]:
    """Run all estimators on one workload.

    Args:
        load: the workload.
        literal: run the literal forms, too.
        device: of torch, where an estimator uses it (eq. 15).
        progress: called with what is going on.
    """
    out = []
    for e in ESTIMATORS:
        progress(e.name)
        rows = getattr(load, e.matrix)
        taken, mib, answer = _apart(e.ours, load, device)
        size, work = e.cost(load)
        part = load.touches if literal else 0
        while part and not all(need <= most for need, most in zip(e.cost(load.first(part)), (MOST_BYTES, MOST_WORK))):
            part //= 2
        mine, other = taken, (Times(np.nan, np.nan), np.nan, None)
        if part:
            less = load if part == load.touches else load.first(part)
            if part < load.touches:
                mine, _, answer = _apart(e.ours, less, device)
            progress(f"{e.name}, literal, {part} touches")
            other = _apart(e.literal, less, device)
        difference = float(np.abs(answer - other[2]).max() / np.abs(other[2]).max()) if part else np.nan
        whole = other[0].clock * work / e.cost(load.first(part))[1] if part else np.nan
        # A processor's time says nothing of a GPU's work.
        counted = "busy" if device == "cpu" else "clock"
        times = getattr(other[0], counted) / max(getattr(mine, counted), 1e-9)
        out.append(Comparison(e.name, rows.shape[0], len(np.unique(rows.indices)), taken, mib, part, mine, other[0],
                              other[1], times, difference, size, whole))
    return out


def report(settings: Mapping[str, Any], rows: Sequence[Comparison]) -> Measurement:
    """The comparisons, with those that ran on fewer touches in a table of their own."""
    stored = [{**asdict(row), "time": row.time._asdict(), "ours_on_part": row.ours_on_part._asdict(),
               "literal": row.literal._asdict()} for row in rows]
    tables = [Table("estimators, the whole workload", (
        Column("name", "estimator"), Column("rows", "rows", "1", form=","),
        Column("particles", "particles", "1", form=","), Column("time.clock", "clock", "s", form=".3f"),
        Column("time.busy", "CPU", "s", form=".3f"), Column("mib", "memory", "MiB", form=".0f"),
        Column("literal_bytes", "literal form would need", "B", "GB", ".1f"),
        Column("literal_whole", "and take about", "s", form=".0f")), stored, name="estimators")]
    if any(row.part for row in rows):
        tables.append(Table("against the literal forms, on as many touches as they can take", (
            Column("name", "estimator"), Column("part", "touches", "1"),
            Column("ours_on_part.clock", "clock", "s", form=".3f"), Column("ours_on_part.busy", "CPU", "s", form=".3f"),
            Column("literal.clock", "literal clock", "s", form=".2f"),
            Column("literal.busy", "literal CPU", "s", form=".2f"),
            Column("literal_mib", "literal memory", "MiB", form=".0f"), Column("times", "times", "1", form=".0f"),
            Column("difference", "difference", "1", form=".1e")), [row for row in stored if row["part"]]))
    return Measurement.of("methods", settings, tables)


def measure(load: Workload, *, literal: bool = True, device: str = "cpu",
            progress: Progress = lambda _: None) -> Measurement:
    """`compare` as a measurement."""
    settings = {"particles": load.pressure.shape[1], "touches": load.touches, "frames": load.frames,
                "literal": literal, "device": device}
    return report(settings, compare(load, literal=literal, device=device, progress=progress))


def _timed(work: Callable[[], np.ndarray]) -> tuple[Times, np.ndarray]:
    best, spent = Times(np.inf, np.inf), 0.0
    for _ in range(_REPEATS):
        start, busy = time.perf_counter(), time.process_time()
        out = work()
        took = Times(time.perf_counter() - start, time.process_time() - busy)
        best = Times(*map(min, best, took))
        spent += took.clock
        if spent > _SHORT:
            break
    return best, out


def _apart(work: Callable[[Workload, str], tuple[Times, np.ndarray]], load: Workload,
           device: str) -> tuple[Times, float, np.ndarray]:
    """Time, memory above that of the loaded workload [MiB], and the answer, from a process of its own."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_measured, (work, load, device))


def _measured(work: Callable[[Workload, str], tuple[Times, np.ndarray]], load: Workload,
              device: str) -> tuple[Times, float, np.ndarray]:
    import torch  # noqa: F401  its own size is not the method's

    before = held_memory(reset=True)
    taken, answer = work(load, device)
    return taken, peak_memory() - before, answer
