"""`vsfsim cluster COMMAND`: the machines that make the parts of a command: a shard beside others, or a cluster."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated

import typer

from vsfsim.cli.options import Several
from vsfsim.core.errors import VsfsimError, one_of
from vsfsim.core.system.engines import Fan, shard_of

ENGINES = ("ray", "slurm", "k8s")
DIVIDED = ("generate", "evaluate")
"""Commands whose work has parts."""


@dataclass(frozen=True)
class Machines:
    """What makes the parts; by default this machine."""

    on: str | None = None
    """Engine of a cluster: ray; or slurm or k8s, whose file is printed, for `sbatch` or `kubectl apply -f`."""
    address: str = "auto"
    """Of the Ray cluster, HOST:PORT."""
    gpus_per_task: Annotated[float, typer.Option(min=0.0)] = 0.0
    """GPUs of each task of a cluster."""
    shard: Annotated[str | None, typer.Option(metavar="I/N")] = None
    """Make the I-th of N shares, from 0, beside other machines; auto: of a Slurm array, auto/N: of a Kubernetes
    Indexed Job."""
    shards: Several = None
    """Tasks of a Slurm array or pods of a Kubernetes job; default: 100, at most one a part."""

    def fan(self) -> Fan:
        """Where the parts are made.

        Raises:
            VsfsimError: no such engine or shard, or options that do not go together.
        """
        if self.on is not None:
            one_of(self.on, ENGINES, "--on")
        part = shard_of(self.shard) if self.shard is not None else None
        if part and self.on:
            raise VsfsimError("--shard and --on do not go together. Each machine of a cluster makes a --shard; --on "
                              "makes the shards there.")
        return Fan(part, self.address if self.on == "ray" else "", self.gpus_per_task)


ASKED: ContextVar[tuple[Machines, list[str]]] = ContextVar("asked", default=(Machines(), []))
"""The options of `vsfsim cluster`, and the command after them."""


def asked() -> Fan:
    """Where `vsfsim cluster` wants the parts of the command that runs."""
    return ASKED.get()[0].fan()


def by_shards(usual: int) -> bool:
    """If a scheduler makes the parts of the command that runs, print its file.

    Args:
        usual: how many shards if nobody says.

    Returns:
        Whether the file was printed, and nothing is to be made here.

    Raises:
        VsfsimError: a word of the command cannot stand in such a file, or there are too many shards.
    """
    machines, words = ASKED.get()
    if machines.on not in ("slurm", "k8s"):
        return False
    from vsfsim.core.system.engines import job_file

    print(job_file(machines.on, words, machines.shards or usual, gpus=int(machines.gpus_per_task)), end="")
    return True
