"""The stages of an evaluation: a training, and the runs that use it. An interrupted evaluation keeps whole stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vsfsim.bench.task import ALL, Protocol
from vsfsim.bench.trials.folds import Fold


@dataclass(frozen=True)
class Stage:
    """Some runs on the test objects of one fold, after one training."""

    name: str
    """Of the file in which its answers are kept."""
    fold: int
    """Number of the fold."""
    train: tuple[str, ...]
    """Names of the views that the method learns from."""
    test: tuple[str, ...]
    """Names of the views that are scored."""
    seed: int | None
    """That the method is built with; None for a method without one."""
    runs: tuple[int, ...]
    """Numbers of the runs."""
    complete: tuple[int, ...]
    """Runs with the shots whose support set is the same in every draw: 0 touches and all of them."""

    def shots(self, run: int, protocol: Protocol) -> tuple[str, ...]:
        """Labels of the shots that are made in a run.

        Without a ``seed`` a method must be deterministic, so that a support set that is the same in every draw needs
        only one adaptation after a training.
        """
        return tuple(label for label in protocol.labels if run in self.complete or label not in ("0", ALL))

    def trials(self, protocol: Protocol) -> int:
        """Number of adaptations."""
        return len(self.test) * sum(len(self.shots(run, protocol)) for run in self.runs)


def first_run(protocol: Protocol, run: int, runs: Sequence[int], *, seeded: bool) -> int:
    """The run after the same training in which the shots with one support set for all draws are made."""
    if not protocol.folds:
        return run if seeded else runs[0]
    return next(one for one in runs if protocol.training_of(one) == protocol.training_of(run))


def stages(protocol: Protocol, folds: Sequence[Fold], runs: Sequence[int], *, seeded: bool) -> tuple[Stage, ...]:
    """The stages of an evaluation in their order, so that those with the same training follow one another.

    Args:
        protocol: of the task. folds: of its dataset. runs: to be made. seeded: the method takes a ``seed``.
    """
    complete = tuple(run for run in runs if first_run(protocol, run, runs, seeded=seeded) == run)
    if not protocol.folds:  # one training for all seeds, or one a seed
        (fold,) = folds
        return tuple(Stage(f"seed-{run:04d}", fold.number, fold.train, fold.test, run if seeded else None, (run,),
                           complete) for run in runs)
    trainings = sorted({protocol.training_of(run) for run in runs})
    return tuple(Stage(f"fold-{fold.number:02d}-training-{k:02d}", fold.number, fold.train, fold.test,
                       k if seeded else None, tuple(run for run in runs if protocol.training_of(run) == k), complete)
                 for k in trainings for fold in folds)
