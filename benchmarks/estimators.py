"""Every estimator against its literal dense form, at equal answers: `vsfsim measure methods`.

The literal forms are the papers' equations written down with dense matrices over the touched particles, as openvsf has
them: eq. 15 with W B Sigma B^T W^T + Sigma_Z, its inverse and automatic differentiation; eq. 16 as one dense least
squares problem with bounds; the diagonal Kalman filter with a dense gain. Each runs in a process of its own, so that
its peak memory is its own; what takes less than some seconds is run again, and the fastest run counts. On a CPU the
processor's time is compared, which other programs on the machine do not change; the time on the clock stands beside it.
Where a literal form would not fit, or take minutes, both are run on as many of the workload's touches as it can take,
and its time for the whole is estimated from its number of operations.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import optimize, sparse

from benchmarks.process_memory import held_memory, peak_memory
from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.kalman import DiagonalFilter
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.fields.palpation import layer_with_inclusion, palpate
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.sticking import stick

# Dense matrices of the literal forms beyond this are not tried: they would swap, or end the process.
MOST_BYTES = 4e9
# Nor are operations beyond this: some minutes of one core.
MOST_WORK = 3e12
NOISE, MEAN, STD = 0.05, 20.0, 30.0
# Runs shorter than this are repeated, so often at most [s].
_SHORT, _REPEATS = 3.0, 5

# (particles, touches, frames): 2,000 readings of 2,000 particles; 900 frames of 20,000 (the paper's).
MINI, PAPER = (2000, 100, 20), (20_000, 60, 15)


class Times(NamedTuple):
    """Of the fastest run. clock: on the clock [s]. busy: of the processor, all threads together [s]."""

    clock: float
    busy: float


@dataclass(frozen=True)
class Workload:
    """Observation matrices of a synthetic palpation. pressure: force sums (T_all, n) [m]. pressure_z: their readings
    (T_all,) [N].
    touch: which touch each is of (T_all,). dense: contact forces (T_all N 3, n) [m]. dense_z: their readings (T_all N
    3,) [N].
    frame: rows of ``dense`` in a frame. frames: of a touch."""

    pressure: sparse.csr_matrix
    pressure_z: np.ndarray
    touch: np.ndarray
    dense: sparse.csr_matrix
    dense_z: np.ndarray
    frame: int
    frames: int

    @classmethod
    def of(cls, particles: int, touches: int, frames: int, *, seed: int = 0) -> Workload:
        """About ``particles`` particles in a 16 x 12 x 1.5 cm volume under ``touches`` presses of ``frames`` frames.

        Raises:
            VsfError: a size below 1, or fewer than two frames.
        """
        points, spacing = volume_points(particles, touches, frames)
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
        return cls(pressure, z[0], np.repeat(np.arange(touches), frames), dense, z[1], 3 * vertices, frames)

    def first(self, touches: int) -> Workload:
        """The same with the first ``touches`` touches only."""
        rows = touches * self.frames
        return Workload(self.pressure[:rows], self.pressure_z[:rows], self.touch[:rows], self.dense[:rows * self.frame],
                        self.dense_z[:rows * self.frame], self.frame, self.frames)

    def export(self, folder: Path) -> None:
        """Write the workload for an estimator from elsewhere: pressure.npz and dense.npz (CSR,
        `scipy.sparse.load_npz`), readings.npz and readings.json, which says what each is and gives the noise and the
        prior.

        Raises:
            VsfError: the folder cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            sparse.save_npz(folder / "pressure.npz", self.pressure)
            sparse.save_npz(folder / "dense.npz", self.dense)
            np.savez(folder / "readings.npz", pressure=self.pressure_z, dense=self.dense_z, touch=self.touch)
            (folder / "readings.json").write_text(json.dumps({
                "model": "z = W K + noise, K >= 0: spring constants K [N/m] of particles, W [m], z [N]",
                "pressure.npz": "W of the force sums, one row a frame: (frames of all touches, particles)",
                "dense.npz": f"W of the contact forces on a sensor's vertices, {self.frame} rows a frame (vertex by "
                             f"vertex, x y z)",
                "readings.npz": {"pressure": "z of pressure.npz", "dense": "z of dense.npz",
                                 "touch": "which touch each frame is of"},
                "frames_of_a_touch": self.frames, "rows_of_a_frame": self.frame, "noise_std_N": NOISE,
                                                              "prior_mean_N_per_m": MEAN, "prior_std_N_per_m": STD},
                                                             indent=1) + "\n")
        except OSError as error:
            raise VsfError(f"bench methods: the workload cannot be written to '{folder}': {error}. Give a folder that "
                           f"can be made.") from error

    @property
    def touches(self) -> int:
        """How many there are."""
        return len(self.pressure_z) // self.frames


def volume_points(particles: int, touches: int, frames: int) -> tuple[np.ndarray, float]:
    """About ``particles`` points (n, 3) [m] on a lattice under z = 0, 16 x 12 x 1.5 cm, and its spacing [m].

    Raises:
        VsfError: a size of the workload is below 1, or there are fewer than two frames.
    """
    if min(particles, touches) < 1 or frames < 2:
        raise VsfError(f"bench methods: {particles} particles, {touches} touches, {frames} frames; give at least "
                       f"1, 1 and 2.")
    spacing = (0.16 * 0.12 * 0.015 / particles) ** (1 / 3)
    axes = [np.arange(-half + 0.5 * spacing, half, spacing) for half in (0.08,
                                                                         0.06)] + [np.arange(-0.015 + 0.5 * spacing,
                                                                                             0.0, spacing)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), spacing


@dataclass(frozen=True)
class Estimator:
    """One estimator in both forms.

    ours, literal: (workload, device) -> (time, answer). matrix: name of the rows it reads.
    needs: (rows, touched particles, particles moved at once, rows of a frame) -> bytes [B] and operations [-] of the
    literal form.
    """

    name: str
    ours: Callable[[Workload, str], tuple[Times, np.ndarray]]
    literal: Callable[[Workload, str], tuple[Times, np.ndarray]]
    matrix: str
    needs: Callable[[float, float, float, float], tuple[float, float]]

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
    w, z = torch.tensor(load.pressure[:, touched].toarray(),
                        device=device), torch.tensor(load.pressure_z, device=device)
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
    Estimator("eq. 16 from pressure", batch, batch_literal, "pressure", lambda m, n, k,
              r: (16.0 * (m + n) * n, 12.0 * (m + n) * n * n)),
    Estimator("eq. 16 from contact forces", batch_dense, batch_dense_literal, "dense", lambda m, n, k,
              r: (16.0 * m * n + 24.0 * n * n, 2.0 * m * n * n + 25.0 * n**3)),
    Estimator("diagonal filter", online, online_literal, "dense", lambda m, n, k,
              r: (16.0 * r * (k + r), m / r * (4.0 * r * r * k + 2.0 * r**3))))


@dataclass(frozen=True)
class Comparison:
    """One estimator. rows: of its matrix. particles: touched. time: ours. mib: ours [MiB].
    part: touches of the workload that both were run on for the comparison (all of them where the literal form takes
    them), 0 without one.
    ours_on_part, literal: there. literal_mib: its memory there [MiB]. times: literal over ours there [-]. difference:
    of the answers, over the largest value [-].
    literal_bytes: that it would take on the whole [B]. literal_whole: time that it would, from its number of operations
    [s]."""

    name: str
    rows: int
    particles: int
    time: Times
    mib: float
    part: int
    ours_on_part: Times
    literal: Times
    literal_mib: float
    times: float
    difference: float
    literal_bytes: float
    literal_whole: float


def compare(load: Workload, *, literal: bool = True, device: str = "cpu", export: Path | None = None,
            progress: Callable[[int, int, str], None] | None = None) -> list[Comparison]:
    """Run all estimators on one workload.

    Args:
        load: the workload. literal: run the literal forms, too. device: of torch, where an estimator uses it (eq. 15).
        export: folder to write the workload to, see `Workload.export`. progress: called with (done, of how many, what).
    """
    if export is not None:
        load.export(export)
    out = []
    for index, e in enumerate(ESTIMATORS):
        if progress is not None:
            progress(index, len(ESTIMATORS), e.name)
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
            if progress is not None:
                progress(index, len(ESTIMATORS), f"{e.name}, literal, {part} touches")
            other = _apart(e.literal, less, device)
        difference = float(np.abs(answer - other[2]).max() / np.abs(other[2]).max()) if part else np.nan
        whole = other[0].clock * work / e.cost(load.first(part))[1] if part else np.nan
        # A processor's time says nothing of a GPU's work.
        counted = "busy" if device == "cpu" else "clock"
        times = getattr(other[0], counted) / max(getattr(mine, counted), 1e-9)
        out.append(Comparison(e.name, rows.shape[0], len(np.unique(rows.indices)), taken, mib, part, mine, other[0],
                              other[1], times, difference, size, whole))
    return out


def table(rows: Sequence[Comparison], touches: int) -> str:
    """For a terminal."""
    names = [f"{row.name}, {row.rows:,} x {row.particles:,}" for row in rows]
    width = max(map(len, names))
    lines = [f"{'':<{width}}  {'clock s':>8} {'busy s':>8} {'MiB':>6}  {'literal s':>9} {'busy s':>8} {'MiB':>6}  "
             f"{'times':>6}  difference"]

    def literal(row: Comparison) -> str:
        return (f"{row.literal.clock:9.2f} {row.literal.busy:8.2f} {row.literal_mib:6.0f}  {row.times:6.0f}  "
                f"{row.difference:.1e}")

    for name, row in zip(names, rows):
        left = f"{name:<{width}}  {row.time.clock:8.3f} {row.time.busy:8.3f} {row.mib:6.0f}  "
        if not row.part:
            lines.append(left + f"literal form not run; it needs {row.literal_bytes / 1e9:.1f} GB")
        elif row.part == touches:
            lines.append(left + literal(row))
        else:
            lines.append(left + f"literal form needs {row.literal_bytes / 1e9:.1f} GB and about "
                                f"{row.literal_whole:.0f} s; measured on fewer touches:")
            lines.append(f"{f'  the first {row.part} touches':<{width}}  {row.ours_on_part.clock:8.3f} "
                         f"{row.ours_on_part.busy:8.3f} {'':>6}  " + literal(row))
    return "\n".join(lines)


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
