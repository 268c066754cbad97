"""The meta-prior of SBML: from visual features to the mean and variance of each component's stiffness (appendix B.3),
and its training.

HE components go through a perceptron [F, 256, 128, 2] with dropout; HO and SEG components have a linear mean and one
learned variance.
The 2-D output is made non-negative by a ReLU in the paper. A ReLU that is off has no gradient, and a variance of 0 has
no density, so the default here is the softplus; `output="relu"` is the paper's, with a floor under the variance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from vsfsim.core.errors import VsfError, did_you_mean
from vsfsim.vsf.estimate.evidence import Evidence
from vsfsim.vsf.fields.adam import Adam
from vsfsim.vsf.meta.composition import Composition, GaussianPrior

OUTPUTS = ("softplus", "relu")
_LEAST_STD = 1e-3
"""Floor under a standard deviation, in units of the training spread."""
# Numbers in the largest block under which one thread is faster than several.
_SMALL = 500_000


@dataclass(frozen=True)
class Spread:
    """What the training objects' own fits say about their stiffnesses [N/m], for the initial uncertainty (SBML section
    3.3).

    mean: of all touched particles [N/m]. std: of one particle around it [N/m]. shared_std: of a shared component (of
    the objects' means for HO, of the segments' for SEG) [N/m]; 0 for HE.
    """

    mean: float
    std: float
    shared_std: float = 0.0


@dataclass(frozen=True)
class MetaTask:
    """One training object: normalised features of its touched particles (k, F) and of its shared components (s, F), and
    its readings."""

    features: torch.Tensor
    shared: torch.Tensor
    evidence: Evidence


class MetaPrior(nn.Module):
    """psi of the paper.

    Args:
        size: of a feature, F. shared: the structure has HO or SEG components. spread: of the training stiffnesses.
        hidden: widths of the hidden layers. dropout: probability. output: one of `OUTPUTS`.
    """

    def __init__(self, size: int, *, shared: bool, spread: Spread, hidden: Sequence[int] = (256, 128),
                 dropout: float = 0.1, output: str = "softplus"):
        super().__init__()
        if output not in OUTPUTS:
            raise VsfError(f"vsf.meta_prior: output is '{output}'. {did_you_mean(output, OUTPUTS)}")
        if not 0.0 <= dropout < 1.0 or not spread.std > 0.0:
            raise VsfError(f"vsf.meta_prior: dropout is {dropout!r} (0 to under 1) and the training spread "
                           f"{spread.std!r} (greater than 0).")
        widths, layers = [size, *hidden], []
        for a, b in itertools.pairwise(widths):
            layers += [nn.Linear(a, b), nn.ReLU(), nn.Dropout(dropout)]
        self.he = nn.Sequential(*layers, nn.Linear(widths[-1], 2))
        self.output, self.unit = output, spread.std
        last = self.he[-1]
        with torch.no_grad():
            # The first guess is the naive Gaussian prior: the training mean and spread everywhere.
            last.weight.mul_(0.1)
            last.bias.copy_(torch.tensor([self._inverse(max(spread.mean, 0.05 * spread.std) / self.unit),
                                          self._inverse(1.0)]))
        self.shared = nn.Linear(size, 1) if shared else None
        if self.shared is not None:
            nn.init.zeros_(self.shared.weight)
            nn.init.zeros_(self.shared.bias)
            self.shared_log_std = nn.Parameter(torch.tensor(float(np.log(max(spread.shared_std, 0.05 * spread.std)
                                                                         / self.unit))))

    def forward(self, features: torch.Tensor, shared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor,
                                                                             torch.Tensor]:
        """Mean and variance of HE components with ``features`` (k, F), and of shared ones with ``shared`` (s, F) [N/m],
        [(N/m)^2]."""
        raw = self.he(features)
        if self.output == "relu":
            mean, var = functional.relu(raw[:, 0]), functional.relu(raw[:, 1]) + _LEAST_STD**2
        else:
            mean, var = functional.softplus(raw[:, 0]), (functional.softplus(raw[:, 1]) + _LEAST_STD) ** 2
        if self.shared is None:
            none = torch.zeros(0, dtype=raw.dtype, device=raw.device)
            return mean * self.unit, var * self.unit**2, none, none
        shared_mean = self.shared(shared)[:, 0]
        shared_var = (2.0 * self.shared_log_std).exp().expand(len(shared)) + _LEAST_STD**2
        return mean * self.unit, var * self.unit**2, shared_mean * self.unit, shared_var * self.unit**2

    @torch.no_grad()
    def of(self, features: np.ndarray, composition: Composition) -> GaussianPrior:
        """The prior of one object from its normalised features (n, F)."""
        self.eval()
        device = self.he[0].weight.device
        given = (torch.as_tensor(np.asarray(x, np.float32), device=device) for x in (features, composition.features))
        mean, var, shared_mean, shared_var = (x.double().cpu().numpy() for x in self(*given))
        return GaussianPrior(mean, var, composition.membership, shared_mean, shared_var)

    def _inverse(self, value: float) -> float:
        return value if self.output == "relu" else float(np.log(np.expm1(value)))


@dataclass(frozen=True)
class Training:
    """How `train` went. best: epoch whose weights were kept. train, validation: NLL of a reading in nats [-], by epoch
    (epoch 0 is before any step)."""

    best: int
    train: tuple[float, ...]
    validation: tuple[float, ...]


def train(prior: MetaPrior, tasks: Sequence[MetaTask], validation: Sequence[MetaTask], *, rate: float = 1e-4,
          epochs: int = 400,
          patience: int = 40, seed: int = 0, progress: Callable[[int, int, str], None] | None = None) -> Training:
    """Fit the meta-prior by maximum likelihood (eq. 15): Adam, one object a step, early stopping.

    Args:
        prior: changed in place; ends with the weights that were best on ``validation``.
        tasks: training objects. validation: others, or none: then all epochs are run.
        rate: of Adam. epochs: at most. patience: epochs without a better validation error until it stops.
        seed: of dropout and of the order of the objects.
        progress: called with (epoch, of how many, what was reached).

    Raises:
        VsfError: no training object with a reading, or the likelihood is no longer finite.
    """
    tasks = [task for task in tasks if task.evidence.blocks]
    validation = [task for task in validation if task.evidence.blocks]
    if not tasks:
        raise VsfError("vsf.train: no touch of a training object reached a particle; give a train split whose touches "
                       "meet the objects.")
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    # Many small matrices: on the CPU, threads that wait for each other cost up to fifteen times what they bring.
    largest = max(block.rows.numel() for task in tasks for block in task.evidence.blocks)
    with _threads(1 if largest < _SMALL else torch.get_num_threads()):
        return _descend(prior, tasks, validation, rate, epochs, patience, seed, rng, progress)


def _descend(prior: MetaPrior, tasks: Sequence[MetaTask], validation: Sequence[MetaTask], rate: float, epochs: int,
             patience: int, seed: int,
             rng: np.random.Generator, progress: Callable[[int, int, str], None] | None) -> Training:
    optimiser = Adam(prior.parameters(), rate=rate)
    best, best_value, kept = 0, score(prior, validation) if validation else np.inf, _copy(prior)
    history, checked = [score(prior, tasks)], [best_value]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for epoch in range(1, epochs + 1):
            prior.train()
            total = 0.0
            for index in rng.permutation(len(tasks)):
                task = tasks[index]
                loss = task.evidence.nll(*prior(task.features, task.shared))
                if not torch.isfinite(loss):
                    raise VsfError(f"vsf.train: the likelihood is not finite at epoch {epoch}; lower the rate, or look "
                                   f"for readings far out of range.")
                optimiser.clear()
                loss.backward()
                optimiser.step()
                total += float(loss.detach())
            history.append(total / sum(task.evidence.readings for task in tasks))
            if validation:
                checked.append(score(prior, validation))
                if checked[-1] < best_value:
                    best, best_value, kept = epoch, checked[-1], _copy(prior)
                elif epoch - best >= patience:
                    break
            else:
                best = epoch
            if progress is not None:
                progress(epoch, epochs, f"NLL {history[-1]:.3f} a reading" + (f", validation {checked[-1]:.3f}"
                                                                              if validation else ""))
    if validation:
        prior.load_state_dict(kept)
    prior.eval()
    return Training(best, tuple(history), tuple(checked))


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.no_grad()
def score(prior: MetaPrior, tasks: Sequence[MetaTask]) -> float:
    """NLL a reading of eq. 15, dropout off."""
    prior.eval()
    total = sum(float(task.evidence.nll(*prior(task.features, task.shared))) for task in tasks)
    return total / sum(task.evidence.readings for task in tasks)


def _copy(module: nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}
