"""Every estimator against its literal dense form, at equal answers: `vsfsim bench methods`.

The literal forms are the papers' equations written down with dense matrices: eq. 15 with W B Sigma B^T W^T + Sigma_Z and automatic
differentiation, eq. 16 as one dense least squares problem with bounds, the diagonal Kalman filter with full-width gains. Each runs in a
process of its own, so that its peak memory is its own.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, sparse

from vsfsim.vsf.dynamics import VsfError
from vsfsim.vsf.estimate import map_estimate
from vsfsim.vsf.kalman import DiagonalFilter
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.palpation import layer_with_inclusion, palpate
from vsfsim.vsf.sticking import stick

# Dense matrices of the literal forms beyond this are not tried: they would swap, or end the process.
MOST_BYTES = 4e9
NOISE, MEAN, STD = 0.05, 20.0, 30.0


@dataclass(frozen=True)
class Workload:
    """Observation matrices of a synthetic palpation. pressure: force sums (T_all, n) [m]. pressure_z: their readings (T_all,) [N].
    touch: which touch each is of (T_all,). dense: contact forces (T_all N 3, n) [m]. dense_z: their readings (T_all N 3,) [N].
    frame: rows of ``dense`` in a frame."""

    pressure: sparse.csr_matrix
    pressure_z: np.ndarray
    touch: np.ndarray
    dense: sparse.csr_matrix
    dense_z: np.ndarray
    frame: int

    @classmethod
    def of(cls, particles: int, touches: int, frames: int, *, seed: int = 0) -> Workload:
        """About ``particles`` particles in a 16 x 12 x 1.5 cm volume under ``touches`` presses of ``frames`` frames.

        Raises:
            VsfError: a size below 1, or fewer than two frames.
        """
        if min(particles, touches) < 1 or frames < 2:
            raise VsfError(f"bench methods: {particles} particles, {touches} touches, {frames} frames; give at least 1, 1 and 2.")
        spacing = (0.16 * 0.12 * 0.015 / particles) ** (1 / 3)
        axes = [np.arange(-half + 0.5 * spacing, half, spacing) for half in (0.08, 0.06)] + [np.arange(-0.015 + 0.5 * spacing, 0.0, spacing)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        field = layer_with_inclusion()
        truth = field(points) * spacing**3
        sums, forces, vertices = [], [], 0
        for t in palpate(field, touches=touches, frames=frames, extent=(0.12, 0.08), substeps=1, seed=seed):
            contacts, vertices = stick(points, t.vertices, t.triangles), t.vertices.shape[1]
            sums.append(force_sum_rows(contacts.displacements(), len(points)))
            forces.append(dense_force_rows(contacts, len(points), t.triangles, vertices))
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        pressure, dense = sparse.vstack(sums).tocsr(), sparse.vstack(forces).tocsr()
        z = [w @ truth + NOISE * rng.standard_normal(w.shape[0]) for w in (pressure, dense)]
        return cls(pressure, z[0], np.repeat(np.arange(touches), frames), dense, z[1], 3 * vertices)


def epoch(load: Workload) -> tuple[float, np.ndarray]:
    """Eq. 15 of one object, value and gradient, after a reduction that is made once for all epochs: (seconds of an epoch, answer)."""
    import torch

    from vsfsim.vsf.evidence import Evidence

    evidence = Evidence.of(load.pressure, load.pressure_z, noise_std=NOISE, touch=load.touch)
    n = len(evidence.touched)
    mean, var = torch.full((n,), MEAN, dtype=torch.float64, requires_grad=True), torch.full((n,), STD**2, dtype=torch.float64, requires_grad=True)
    start = time.perf_counter()
    value = evidence.nll(mean, var)
    gradient = torch.autograd.grad(value, [mean, var])
    seconds = time.perf_counter() - start
    return seconds, np.concatenate([[value.item()], *(g.numpy() for g in gradient)])


def epoch_literal(load: Workload) -> tuple[float, np.ndarray]:
    """The same with dense matrices and automatic differentiation."""
    import torch

    n = load.pressure.shape[1]
    w, z = torch.tensor(load.pressure.toarray()), torch.tensor(load.pressure_z)
    mean, var = torch.full((n,), MEAN, dtype=torch.float64, requires_grad=True), torch.full((n,), STD**2, dtype=torch.float64, requires_grad=True)
    start = time.perf_counter()
    spread = w @ torch.diag(var) @ w.T + torch.diag(torch.full((len(z),), NOISE**2, dtype=torch.float64))
    e = z - w @ mean
    value = 0.5 * e @ torch.linalg.solve(spread, e) + 0.5 * torch.logdet(spread) + 0.5 * len(z) * np.log(2.0 * np.pi)
    gradient = torch.autograd.grad(value, [mean, var])
    seconds = time.perf_counter() - start
    touched = np.flatnonzero(np.diff(load.pressure.tocsc().indptr))
    return seconds, np.concatenate([[value.item()], *(g.numpy()[touched] for g in gradient)])


def batch(load: Workload) -> tuple[float, np.ndarray]:
    """Eq. 16 from pressures."""
    return _timed(lambda: map_estimate(load.pressure, load.pressure_z, noise_std=NOISE, prior_mean=MEAN, prior_var=STD**2).mean)


def batch_literal(load: Workload) -> tuple[float, np.ndarray]:
    """Eq. 16 as one dense bounded least squares problem, [W / s; 1 / v] K = [z / s; mu / v], by Lawson and Hanson's active set."""
    n = load.pressure.shape[1]

    def solve() -> np.ndarray:
        a = np.concatenate([load.pressure.toarray() / NOISE, np.eye(n) / STD])
        return optimize.nnls(a, np.concatenate([load.pressure_z / NOISE, np.full(n, MEAN / STD)]), maxiter=100 * n)[0]

    return _timed(solve)


def batch_dense(load: Workload) -> tuple[float, np.ndarray]:
    """Eq. 16 from contact forces on the vertices."""
    return _timed(lambda: map_estimate(load.dense, load.dense_z, noise_std=NOISE, prior_mean=MEAN, prior_var=STD**2).mean)


def batch_dense_literal(load: Workload) -> tuple[float, np.ndarray]:
    """The same as a dense problem; its normal matrix is formed, as any QP solver would be given it."""
    def solve() -> np.ndarray:
        w = load.dense.toarray() / NOISE
        hessian = w.T @ w + np.eye(w.shape[1]) / STD**2
        factor = np.linalg.cholesky(hessian)
        right = np.linalg.solve(factor, w.T @ (load.dense_z / NOISE) + MEAN / STD**2)
        return optimize.nnls(factor.T, right, maxiter=100 * w.shape[1])[0]

    return _timed(solve)


def online(load: Workload) -> tuple[float, np.ndarray]:
    """The diagonal Kalman filter on contact forces, frame by frame."""
    state = DiagonalFilter.start(load.dense.shape[1], mean=MEAN, var=STD**2)
    seconds, _ = _timed(lambda: state.run(load.dense, load.dense_z, noise_std=NOISE, size=load.frame))
    return seconds, np.concatenate([state.mean, state.var])


def online_literal(load: Workload) -> tuple[float, np.ndarray]:
    """The same with a gain over all particles and all vertices."""
    mean, var = np.full(load.dense.shape[1], MEAN), np.full(load.dense.shape[1], STD**2)
    start = time.perf_counter()
    for first in range(0, load.dense.shape[0], load.frame):
        w, z = load.dense[first:first + load.frame].toarray(), load.dense_z[first:first + load.frame]
        gain = (var[:, None] * w.T) @ np.linalg.inv((w * var) @ w.T + NOISE**2 * np.eye(len(z)))
        mean = np.maximum(mean + gain @ (z - w @ mean), 0.0)
        var = var - np.einsum("nm,mn->n", gain, w * var)
    return time.perf_counter() - start, np.concatenate([mean, var])


@dataclass(frozen=True)
class Comparison:
    """One estimator. seconds: ours [s]. mib: ours [MiB]. literal_seconds: the literal form's [s], literal_mib: its memory [MiB], None where it
    would not fit (see `reason`). difference: largest, over the largest value of the answer [-]."""

    name: str
    seconds: float
    mib: float
    literal_seconds: float | None
    literal_mib: float | None
    difference: float | None
    reason: str = ""


def compare(particles: int, touches: int, frames: int, *, literal: bool = True, progress: Callable[[int, int, str], None] | None = None) -> list[Comparison]:
    """Run all estimators on one workload.

    Args:
        particles, touches, frames: of the workload. literal: run the literal forms, too. progress: called with (done, of how many, what).
    """
    load = Workload.of(particles, touches, frames)
    n, m = load.pressure.shape[1], load.pressure.shape[0]
    pairs: Sequence[tuple[str, Callable, Callable, float]] = (
        (f"eq. 15, value and gradient, {m} readings x {n} particles", epoch, epoch_literal, 8.0 * (4 * m * n + 4 * m * m + n * n)),
        (f"eq. 16 from pressure, {m} x {n}", batch, batch_literal, 16.0 * (m + n) * n),
        (f"eq. 16 from contact forces, {load.dense.shape[0]} x {n}", batch_dense, batch_dense_literal, 16.0 * load.dense.shape[0] * n),
        (f"diagonal filter, {m} frames of {load.frame} x {n}", online, online_literal, 40.0 * load.frame * n))
    out = []
    for index, (name, ours, theirs, size) in enumerate(pairs):
        if progress is not None:
            progress(index, len(pairs), name)
        seconds, mib, answer = _apart(ours, load)
        fits = literal and size <= MOST_BYTES
        other = _apart(theirs, load) if fits else None
        reason = "" if fits else (f"needs {size / 1e9:.0f} GB" if literal else "not asked for")
        difference = float(np.abs(answer - other[2]).max() / np.abs(other[2]).max()) if other else None
        out.append(Comparison(name, seconds, mib, other[0] if other else None, other[1] if other else None, difference, reason))
    return out


def table(rows: Sequence[Comparison]) -> str:
    """For a terminal."""
    width = max(len(row.name) for row in rows)
    lines = [f"{'':<{width}}  {'seconds':>9} {'MiB':>7}  {'literal s':>9} {'MiB':>7}  {'times':>6}  difference"]
    for row in rows:
        left = f"{row.name:<{width}}  {row.seconds:9.3f} {row.mib:7.0f}  "
        if row.literal_seconds is None:
            lines.append(left + row.reason)
        else:
            lines.append(left + f"{row.literal_seconds:9.3f} {row.literal_mib:7.0f}  {row.literal_seconds / max(row.seconds, 1e-9):6.0f}  {row.difference:.1e}")
    return "\n".join(lines)


def _timed(work: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    out = work()
    return time.perf_counter() - start, out


def _apart(work: Callable[[Workload], tuple[float, np.ndarray]], load: Workload) -> tuple[float, float, np.ndarray]:
    """Seconds, memory above that of the loaded workload [MiB], and the answer, from a process of its own."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_measured, (work, load))


def _measured(work: Callable[[Workload], tuple[float, np.ndarray]], load: Workload) -> tuple[float, float, np.ndarray]:
    import torch  # noqa: F401  its own size is not the method's

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds, answer = work(load)
    return seconds, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0, answer
