"""The meta-prior of SBML (appendix B.3) and its training: from visual features to the mean and variance of each
component's stiffness.

HE components go through a perceptron [F, 256, 128, 2] with dropout; HO and SEG components have a linear mean and one
learned variance. The two outputs of the perceptron are the mean and the standard deviation (section 4.1). The paper
makes them non-negative by a ReLU; a ReLU below zero has no gradient, so the default here is the softplus.

Appendix B.3 calls the second output the variance. With a ReLU that cannot be trained well: the gradient of eq. 15 with
respect to a variance grows like its inverse, so steps throw outputs below zero, the variance stays at its floor, and
the likelihood of a whole touch falls at once. Over seven seeds of tests/vsf/test_meta_prior.py's data the validation
NLL fell by 0.18 to 0.27 with a variance and by 0.25 to 0.35 with a standard deviation.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from vsfsim.core.errors import VsfError, one_of
from vsfsim.physics.runtime import torch_threads
from vsfsim.vsf.estimate.evidence import Evidence
from vsfsim.vsf.meta.composition import Composition, GaussianPrior

_NON_NEGATIVE: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "softplus": functional.softplus, "relu": functional.relu}
OUTPUTS = tuple(_NON_NEGATIVE)
SECOND = ("std", "variance")
_LEAST_STD = 1e-3
"""Floor under a standard deviation, in units of the training spread."""
_SMALL = 500_000
"""Entries of the largest block of rows below which one thread is faster than several."""


@dataclass(frozen=True)
class Spread:
    """Statistics of the stiffnesses fitted to each training object alone, for the initial uncertainty (SBML section
    3.3)."""

    mean: float
    """Mean over all touched particles [N/m]."""
    std: float
    """Standard deviation of one particle around it, > 0 [N/m]."""
    shared_std: float = 0.0
    """Standard deviation of a shared component (of the objects' means for HO, of the segments' for SEG) [N/m]; 0 for
    HE."""


@dataclass(frozen=True)
class MetaTask:
    """One training object."""

    features: torch.Tensor
    """Normalised features of its touched particles (k, F)."""
    shared: torch.Tensor
    """Normalised features of its shared components (s, F)."""
    evidence: Evidence
    """Its readings."""


class MetaPrior(nn.Module):
    """psi of the paper.

    Args:
        size: numbers of a feature, F.
        shared: whether the structure has HO or SEG components.
        spread: statistics of the training stiffnesses.
        hidden: widths of the hidden layers.
        dropout: probability, 0 to under 1.
        output: one of `OUTPUTS`.
        level_std: standard deviation of a component common to all particles of an object while the network is trained
            [N/m], where there are no shared components: what distinguishes whole objects need not be learned from
            pictures then. 0 for none, as in the paper.
        second: what the perceptron's second output is, one of `SECOND`: section 4.1 says the standard deviation,
            appendix B.3 the variance.

    Raises:
        VsfError: an unknown output, or a dropout or spread out of range.
    """

    def __init__(self, size: int, *, shared: bool, spread: Spread, hidden: Sequence[int] = (256, 128),
                 dropout: float = 0.1, output: str = "softplus", second: str = "std",
                 level_std: float = 0.0):
        super().__init__()
        one_of(output, OUTPUTS, "vsf.meta_prior: output", VsfError)
        one_of(second, SECOND, "vsf.meta_prior: second", VsfError)
        if not 0.0 <= dropout < 1.0 or not spread.std > 0.0:
            raise VsfError(f"vsf.meta_prior: dropout is {dropout!r} (0 to under 1) and the training spread "
                           f"{spread.std!r} (greater than 0).")
        widths, layers = [size, *hidden], []
        for a, b in itertools.pairwise(widths):
            layers += [nn.Linear(a, b), nn.ReLU(), nn.Dropout(dropout)]
        self.he = nn.Sequential(*layers, nn.Linear(widths[-1], 2))
        self.output, self.second, self.unit, self.level_std = output, second, spread.std, level_std
        last = self.he[-1]
        with torch.no_grad():
            # The initial prior is the naive Gaussian one: the training mean and spread everywhere.
            last.weight.mul_(0.1)
            mean = max(spread.mean, 0.05 * spread.std) / self.unit
            last.bias.copy_(torch.tensor([self._inverse(mean), self._inverse(1.0)]))
        self.shared = nn.Linear(size, 1) if shared else None
        if self.shared is not None:
            nn.init.zeros_(self.shared.weight)
            nn.init.zeros_(self.shared.bias)
            shared_std = max(spread.shared_std, 0.05 * spread.std) / self.unit
            self.shared_log_std = nn.Parameter(torch.tensor(float(np.log(shared_std))))

    def forward(self, features: torch.Tensor,
                shared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Mean (k,) [N/m] and variance (k,) [(N/m)^2] of HE components with ``features`` (k, F), then both of shared
        components with ``shared`` (s, F)."""
        raw = self.he(features)
        non_negative = _NON_NEGATIVE[self.output]
        mean, spread = non_negative(raw[:, 0]), non_negative(raw[:, 1])
        var = (spread + _LEAST_STD) ** 2 if self.second == "std" else spread + _LEAST_STD**2
        if self.shared is None:
            none = torch.zeros(len(shared), dtype=raw.dtype, device=raw.device)
            return mean * self.unit, var * self.unit**2, none, none + self.level_std**2
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
    """History of `train`."""

    best: int
    """Epoch whose weights were kept."""
    train: tuple[float, ...]
    """NLL of a reading in nats [-] by epoch, on the training objects; epoch 0 is before any step."""
    validation: tuple[float, ...]
    """The same on the validation objects [-]."""


def train(prior: MetaPrior, tasks: Sequence[MetaTask], validation: Sequence[MetaTask], *, rate: float = 1e-4,
          epochs: int = 400, patience: int = 40, seed: int = 0) -> Training:
    """Fit the meta-prior by maximum likelihood (eq. 15): Adam, one object a step, early stopping.

    Args:
        prior: changed in place; ends with the weights that were best on ``validation``.
        tasks: training objects.
        validation: other objects; without any, all epochs are run.
        rate: learning rate of Adam.
        epochs: the most epochs that are run.
        patience: epochs without a lower validation NLL after which training stops.
        seed: of dropout and of the order of the objects.

    Raises:
        VsfError: no training object with a reading, or the likelihood is no longer finite.
    """
    tasks = [task for task in tasks if task.evidence.blocks]
    validation = [task for task in validation if task.evidence.blocks]
    if not tasks:
        raise VsfError("vsf.train: no touch of a training object reached a particle; give a train split whose touches "
                       "meet the objects.")
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    # On the CPU, synchronising threads over many small matrices costs up to fifteen times what they gain.
    largest = max(block.matrix.numel() for task in tasks for block in task.evidence.blocks)
    with torch_threads(1 if largest < _SMALL else torch.get_num_threads()):
        return _descend(prior, tasks, validation, rate, epochs, patience, seed, rng)


def _descend(prior: MetaPrior, tasks: Sequence[MetaTask], validation: Sequence[MetaTask], rate: float, epochs: int,
             patience: int, seed: int, rng: np.random.Generator) -> Training:
    optimiser = torch.optim.Adam(prior.parameters(), lr=rate, foreach=True)
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
                optimiser.zero_grad()
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
    if validation:
        prior.load_state_dict(kept)
    prior.eval()
    return Training(best, tuple(history), tuple(checked))


@torch.no_grad()
def score(prior: MetaPrior, tasks: Sequence[MetaTask]) -> float:
    """NLL of a reading by eq. 15, in nats [-], without dropout."""
    prior.eval()
    total = sum(float(task.evidence.nll(*prior(task.features, task.shared))) for task in tasks)
    return total / sum(task.evidence.readings for task in tasks)


def _copy(module: nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}
