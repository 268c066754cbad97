"""`vsfsim cluster COMMAND`: the machines that make the parts of a command: a shard beside others, or a cluster."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated

import typer

from vsfsim.cli.options import Several, check_choice
from vsfsim.core.errors import VsfsimError
from vsfsim.core.system.engines import Fan, shard_of

ENGINES = ("ray", "slurm", "k8s")
DIVIDED = ("generate", "evaluate", "papers")
"""Commands whose work has parts."""


@dataclass(frozen=True)
class Machines:
    """What makes the parts; by default this machine."""

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


ASKED: ContextVar[tuple[Machines, list[str]]] = ContextVar("asked", default=(Machines(), []))
"""The options of `vsfsim cluster`, and the command after them."""


def asked() -> Fan:
    """Where `vsfsim cluster` wants the parts of the command that runs."""
    return ASKED.get()[0].fan()


def by_shards(usual: int) -> bool:
    """If a scheduler makes the parts of the command that runs, print its file, or make all shards by Slurm.

    Args:
        usual: how many shards if nobody says.

    Returns:
        Whether the file was printed, and nothing is to be made here.

    Raises:
        VsfsimError: shards failed, or there is no Slurm.
    """
    from vsfsim.core.system import engines

    machines, words = ASKED.get()
    shards, gpus = machines.shards or usual, int(machines.gpus_per_task)
    if machines.printed:
        print(engines.job_file(str(machines.on), words, shards, gpus=gpus), end="")
    elif machines.on == "slurm":
        engines.submit(words, shards, gpus=gpus)
    return machines.printed
