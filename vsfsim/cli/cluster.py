"""The machines that make the parts of a command: this one, a shard beside others, or a cluster."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import typer

from vsfsim.cli.options import Several, check_choice
from vsfsim.core.errors import VsfsimError
from vsfsim.core.system.engines import Fan, shard_of

ENGINES = ("ray", "slurm", "k8s")
_ENGINE_WORDS = ("--on", "--address", "--gpus-per-task", "--shards", "--json")
"""Options with a value that the command of one shard does not repeat; nor does it --print."""


@dataclass(frozen=True)
class Machines:
    """Options of the commands whose parts a cluster may make."""

    on: str | None = None
    """Engine of a cluster: ray, slurm or k8s."""
    address: str = "auto"
    """Of the Ray cluster, HOST:PORT."""
    gpus_per_task: Annotated[float, typer.Option(min=0.0)] = 0.0
    """GPUs of each task of a cluster."""
    shard: Annotated[str | None, typer.Option(metavar="I/N")] = None
    """Make the I-th of N shares, from 0, beside other machines; auto: of a Slurm array, auto/N: of a Kubernetes
    Indexed Job."""
    shards: Several = None
    """Tasks of a Slurm array or pods of a Kubernetes job; default: 100, at most one a part."""
    printed: Annotated[bool, typer.Option("--print")] = False
    """Print the file for Slurm or Kubernetes and make nothing."""

    def fan(self) -> Fan:
        """Where the parts are made.

        Raises:
            VsfsimError: no such engine or shard, or options that do not go together.
        """
        if self.on is not None:
            check_choice("--on", self.on, ENGINES)
        part = shard_of(self.shard) if self.shard is not None else None
        for wrong, words in ((part and self.on, "--shard and --on"),
                             (self.printed and self.on in (None, "ray"), "--print without --on slurm or --on k8s"),
                             (self.on == "k8s" and not self.printed, "--on k8s without --print")):
            if wrong:
                raise VsfsimError(f"{words} do not go together. Each machine of a cluster makes a --shard; --on makes "
                                  f"the shards there.")
        return Fan(part, self.address if self.on == "ray" else "", self.gpus_per_task)

    @property
    def scheduled(self) -> bool:
        """Whether a scheduler makes the parts."""
        return self.on in ("slurm", "k8s")

    def by_shards(self, usual: int, finish: Sequence[str] = ()) -> bool:
        """Print the file of a scheduler, or make all shards of this command by Slurm.

        Args:
            usual: how many shards if nobody says. finish: words that the command which ends the work has besides.

        Returns:
            Whether the shards were made.

        Raises:
            VsfsimError: shards failed, or there is no Slurm.
        """
        from vsfsim.core.system import engines

        words, shards, gpus = shard_words(sys.argv[1:]), self.shards or usual, int(self.gpus_per_task)
        if self.printed:
            print(engines.job_file(str(self.on), words, shards, finish=[*words, *finish], gpus=gpus), end="")
        else:
            engines.submit(words, shards, gpus=gpus)
        return not self.printed


def shard_words(given: Sequence[str]) -> list[str]:
    """The command of one shard, from the words of the command that asks for an engine."""
    out, words = ["vsfsim"], list(given)
    while words:
        word = words.pop(0)
        name, equals, _ = word.partition("=")
        if name in _ENGINE_WORDS:
            if not equals:
                words.pop(0)
        elif word != "--print":
            out.append(word)
    return out
