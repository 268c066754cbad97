"""Cost of SBML's offline training at the paper's size: `vsfsim measure methods --sbml`.

One training object of 10,000 readings and 20,000 particles (200 presses of 50 frames), features of 384 numbers and the
paper's network. Measured are the time to reduce the readings, once an object, and the time of a step: eq. 15 and its
gradient through the network to Adam. A training of the paper's kind is objects x epochs such steps. A ball presses
straight down: a particle in its way moves along the press by as much as the ball's surface has passed it.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np
import torch
from scipy import sparse

from measurements.cost import most_memory, start_memory, wait
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.workload import volume_points
from vsfsim.vsf.estimate.evidence import Evidence
from vsfsim.vsf.meta.prior import MetaPrior, Spread

PAPER = (20_000, 200, 50)
"""(particles, presses, frames of each): the upper end of the paper's sizes."""
FEATURES = 384
"""Numbers of a feature: DINOv2 ViT-S/14."""
OBJECTS, EPOCHS = 20, 400
"""Of the training whose time is estimated; 400 epochs is the most that `baselines.sbml` makes."""

_BALL, _DEPTH, _NOISE, _MEAN = 0.03, 0.012, 0.05, 20.0
_STEPS, _ENOUGH = 5, 20.0  # steps at most, and the time after which no other one begins [s]


@dataclass(frozen=True)
class TrainingCost:
    """Cost of one object's share of a training."""

    readings: int
    """Of the object [-]."""
    particles: int
    """Of the object [-]."""
    touched: int
    """Particles that some reading moves [-]."""
    device: str
    """Of torch."""
    reduce: float
    """Time of the reduction [s]."""
    step: float
    """Time of one training step, the fastest of some [s]."""
    mib: float
    """Peak memory on the device, or of the process beyond what it held before the reduction [MiB]."""
    value: tuple[float, float]
    """Negative log likelihood a reading at the first and the last step [-]."""

    @property
    def whole(self) -> float:
        """Estimated time of a training of `OBJECTS` objects and `EPOCHS` epochs [s]."""
        return OBJECTS * (self.reduce + EPOCHS * self.step)


def readings(particles: int, presses: int, frames: int, *,
             seed: int = 0) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
    """Force sums W (m, n) [m] of straight presses all over a 16 x 12 x 1.5 cm volume, readings z (m,) [N] and the press
    of each (m,).

    Raises:
        VsfError: a size below 1, or fewer than two frames.
    """
    points, _ = volume_points(particles, presses, frames)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
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


def train(particles: int, presses: int, frames: int, *, device: str = "cpu",
          progress: Progress = lambda _: None) -> TrainingCost:
    """Time one object's share of a training.

    Args:
        particles, presses, frames: of the object.
        device: of torch.
        progress: called with what is going on.
    """
    progress(f"SBML: {presses * frames:,} readings of {particles:,} particles")
    w, z, touch = readings(particles, presses, frames)
    before = start_memory(device)
    start = time.perf_counter()
    evidence = Evidence.of(w, z, noise_std=_NOISE, touch=touch, device=device)
    wait(device)
    reduce = time.perf_counter() - start
    progress(f"SBML: up to {_STEPS} training steps on {device}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        prior = MetaPrior(FEATURES, shared=False, spread=Spread(_MEAN, _MEAN)).to(device)
        features = torch.randn(len(evidence.touched), FEATURES).to(device)
    none = torch.zeros(0, FEATURES, device=device)
    optimiser = torch.optim.Adam(prior.parameters(), lr=1e-4, foreach=True)
    best, values, begun = np.inf, [], time.perf_counter()
    while len(values) < _STEPS and (not values or time.perf_counter() - begun < _ENOUGH):
        start = time.perf_counter()
        loss = evidence.nll(*prior(features, none))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        values.append(float(loss.detach()) / evidence.readings)
        wait(device)
        best = min(best, time.perf_counter() - start)
    return TrainingCost(len(z), w.shape[1], len(evidence.touched), device, reduce, best, most_memory(device) - before,
                        (values[0], values[-1]))


def measure(particles: int, presses: int, frames: int, *, device: str = "cpu",
            progress: Progress = lambda _: None) -> Measurement:
    """`train` as a measurement."""
    cost = train(particles, presses, frames, device=device, progress=progress)
    return Measurement.of("methods --sbml", {"particles": particles, "presses": presses, "frames": frames,
                                             "device": device}, [
        Table(f"SBML, eq. 15 through the network, {FEATURES} features", (
            Column("readings", "readings", "1", form=","), Column("particles", "particles", "1", form=","),
            Column("touched", "touched particles", "1", form=","),
            Column("reduce", "reduction, once an object", "s", form=".2f"),
            Column("step", "a step (an object's epoch)", "s", form=".3f"), Column("mib", "memory", "MiB", form=".0f"),
            Column("value.0", "NLL a reading, first step", "1", form=".3f"),
            Column("value.1", "NLL a reading, last step", "1", form=".3f"),
            Column("whole", f"{OBJECTS} objects, {EPOCHS} epochs, estimated", "s", "min", ".1f")),
            [{**asdict(cost), "whole": cost.whole}], name="training", single=True)])
