"""SBML's offline training at the paper's size: `vsfsim measure methods --sbml`.

One training object of 10,000 readings and 20,000 particles (200 presses of 50 frames), features of 384 numbers and the
paper's network. Printed are the time to reduce
the readings, which is done once, and that of a step: eq. 15 and its gradient through the network to Adam. A training of
the paper's kind is objects x epochs such steps. Presses are straight ones of a ball: a particle in its way is pushed
along the press as far as the ball's surface has come past it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from benchmarks.process_memory import held_memory, peak_memory
from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.evidence import Evidence
from vsfsim.vsf.fields.adam import Adam
from vsfsim.vsf.meta.prior import MetaPrior, Spread

# (particles, presses, frames of each): the paper's upper end, and the size that `measure methods` has.
PAPER, MINI = (20_000, 200, 50), (2000, 100, 20)
FEATURES = 384
"""Numbers of a feature: DINOv2 ViT-S/14."""
OBJECTS, EPOCHS = 20, 400
"""Of the training that the estimate is for; 400 epochs is the most that `baselines.sbml` makes."""

_BALL, _DEPTH, _NOISE, _MEAN = 0.03, 0.012, 0.05, 20.0
# Steps at most, and seconds after which no more are begun: on a CPU one of the paper's size takes minutes.
_STEPS, _ENOUGH = 5, 20.0


@dataclass(frozen=True)
class TrainingCost:
    """readings, particles: of one object; touched: particles that some reading moves. reduce: seconds of the reduction
    [s]. step: of one training step, the fastest of some [s]. mib: peak memory on the device, or of the process beyond
    what it held before the reduction [MiB]. value: NLL a reading at the first and the last step, in nats [-]."""

    readings: int
    particles: int
    touched: int
    device: str
    reduce: float
    step: float
    mib: float
    value: tuple[float, float]


def readings(particles: int, presses: int, frames: int, *, seed: int = 0) -> tuple[sparse.csr_matrix, np.ndarray,
                                                                                   np.ndarray]:
    """Force sums W (m, n) [m] of straight presses all over a 16 x 12 x 1.5 cm volume, readings z (m,) [N] and the press
    of each (m,).

    Raises:
        VsfError: a size below 1, or fewer than two frames.
    """
    if min(particles, presses) < 1 or frames < 2:
        raise VsfError(f"bench methods --sbml: {particles} particles, {presses} touches, {frames} frames; give at "
                       f"least 1, 1 and 2.")
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    spacing = (0.16 * 0.12 * 0.015 / particles) ** (1 / 3)
    axes = [np.arange(-half + 0.5 * spacing, half, spacing) for half in (0.08,
                                                                         0.06)] + [np.arange(-0.015 + 0.5 * spacing,
                                                                                             0.0, spacing)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    truth = _MEAN * np.exp(rng.normal(0.0, 1.0, len(points)))
    travel, blocks = np.linspace(0.0, _DEPTH, frames + 1)[1:], []
    for _ in range(presses):
        away = np.hypot(*(points[:, :2] - rng.uniform(-0.5, 0.5, 2) * (0.12, 0.08)).T)
        # The way of the ball until its surface is at the particle.
        clear = _BALL - np.sqrt(np.maximum(_BALL**2 - away**2, 0.0)) - points[:, 2]
        under = np.flatnonzero((away < _BALL) & (clear < _DEPTH))
        blocks.append(sparse.csr_matrix((np.maximum(travel[:, None] - clear[under], 0.0).ravel(),
                                         np.tile(under, frames), np.arange(frames + 1) * len(under)),
                                        shape=(frames, len(points))))
    w = sparse.vstack(blocks).tocsr()
    return w, w @ truth + _NOISE * rng.standard_normal(w.shape[0]), np.repeat(np.arange(presses), frames)


def measure(particles: int, presses: int, frames: int, *, device: str = "cpu",
            progress: Callable[[str], None] | None = None) -> TrainingCost:
    """Time one object's share of a training.

    Args:
        particles, presses, frames: of the object. device: torch's. progress: called with what is going on.
    """
    tell = progress or (lambda _: None)
    cuda = torch.device(device).type == "cuda"
    tell(f"SBML: {presses * frames:,} readings of {particles:,} particles")
    w, z, touch = readings(particles, presses, frames)
    before = held_memory(reset=True)
    if cuda:
        torch.cuda.init()  # else there is no device yet whose peak could be reset
        torch.cuda.reset_peak_memory_stats(device)
    start = time.perf_counter()
    evidence = Evidence.of(w, z, noise_std=_NOISE, touch=touch, device=device)
    _wait(device)
    reduce = time.perf_counter() - start
    tell(f"SBML: up to {_STEPS} training steps on {device}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        prior = MetaPrior(FEATURES, shared=False, spread=Spread(_MEAN, _MEAN)).to(device)
        features = torch.randn(len(evidence.touched), FEATURES).to(device)
    none = torch.zeros(0, FEATURES, device=device)
    optimiser, best, values, begun = Adam(prior.parameters(), rate=1e-4), np.inf, [], time.perf_counter()
    while len(values) < _STEPS and (not values or time.perf_counter() - begun < _ENOUGH):
        start = time.perf_counter()
        loss = evidence.nll(*prior(features, none))
        optimiser.clear()
        loss.backward()
        optimiser.step()
        values.append(float(loss.detach()) / evidence.readings)
        _wait(device)
        best = min(best, time.perf_counter() - start)
    mib = torch.cuda.max_memory_allocated(device) / 2**20 if cuda else peak_memory() - before
    return TrainingCost(len(z), w.shape[1], len(evidence.touched), device, reduce, best, mib, (values[0], values[-1]))


def table(cost: TrainingCost) -> str:
    """For a terminal."""
    whole = OBJECTS * (cost.reduce + EPOCHS * cost.step)
    return (f"SBML, eq. 15 through the network, {cost.readings:,} readings x {cost.particles:,} particles "
            f"({cost.touched:,} touched), {FEATURES} features, on {cost.device}\n"
            f"  reduction, once an object    {cost.reduce:8.2f} s\n"
            f"  a step (an object's epoch)   {cost.step:8.3f} s, {cost.mib:.0f} MiB, NLL a reading {cost.value[0]:.3f} "
            f"-> {cost.value[1]:.3f}\n"
            f"  {OBJECTS} objects, {EPOCHS} epochs        {whole / 60.0:8.1f} min, estimated from the two")


def _wait(device: str) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
