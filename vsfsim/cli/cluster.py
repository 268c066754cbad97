"""Options of the commands whose parts a cluster may make, and the files for its scheduler."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from vsfsim.cli.options import check_choice
from vsfsim.core.errors import VsfsimError
from vsfsim.core.system.engines import Fan, shard_of

ENGINES = ("ray", "slurm", "k8s")
_ENGINE_WORDS = ("--on", "--address", "--gpus-per-task", "--shards", "--json")
"""Options with a value that the command of one shard does not repeat; nor does it --print."""

GROUP = "Machines"
"""Of the options of a cluster in the help."""
On = Annotated[str | None, typer.Option("--on", rich_help_panel=GROUP, help="Engine of a cluster: ray, slurm or k8s.")]
Address = Annotated[str, typer.Option("--address", rich_help_panel=GROUP, help="Of the Ray cluster, HOST:PORT.")]
GpusPerTask = Annotated[float, typer.Option("--gpus-per-task", rich_help_panel=GROUP, min=0.0,
                                                help="GPUs of each task of a cluster.")]
ShardOf = Annotated[str | None, typer.Option("--shard", rich_help_panel=GROUP, metavar="I/N",
                                             help="Make the I-th of N shares, from 0, beside other machines; auto: of "
                                                  "a Slurm array, auto/N: of a Kubernetes Indexed Job.")]
Shards = Annotated[int | None, typer.Option("--shards", rich_help_panel=GROUP, min=1,
                                            help="Tasks of a Slurm array or pods of a Kubernetes job; default: 100, at "
                                                 "most one a part.")]
Printed = Annotated[bool, typer.Option("--print", rich_help_panel=GROUP,
                                       help="Print the file for Slurm or Kubernetes and make nothing.")]


def check_engine(on: str | None, shard: str | None, printed: bool) -> tuple[int, int] | None:
    """The shard that is asked for.

    Raises:
        VsfsimError: no such engine or shard, or options that do not go together.
    """
    if on is not None:
        check_choice("--on", on, ENGINES)
    part = shard_of(shard) if shard is not None else None
    for wrong, words in ((part and on, "--shard and --on"),
                         (printed and on in (None, "ray"), "--print without --on slurm or --on k8s"),
                         (on == "k8s" and not printed, "--on k8s without --print")):
        if wrong:
            raise VsfsimError(f"{words} do not go together. Each machine of a cluster makes a --shard; --on makes the "
                              f"shards there.")
    return part


def fan_of(on: str | None, shard: str | None, printed: bool, address: str, gpus: float) -> Fan:
    """Where the parts of a command are made.

    Raises:
        VsfsimError: as of `check_engine`.
    """
    return Fan(check_engine(on, shard, printed), address if on == "ray" else "", gpus)


def by_shards(engine: str, shards: int, printed: bool, gpus: int, finish: Sequence[str] = ()) -> bool:
    """Print the file of a scheduler, or make all shards of this command by Slurm.

    Args:
        engine: "slurm" or "k8s". shards: how many. printed: print and make nothing. gpus: of each. finish: words that
        the command which ends the work has besides.

    Returns:
        Whether the shards were made.

    Raises:
        VsfsimError: shards failed, or there is no Slurm.
    """
    from vsfsim.core.system import engines

    words = shard_words(sys.argv[1:])
    if printed:
        print(engines.job_file(engine, words, shards, finish=[*words, *finish], gpus=gpus), end="")
    else:
        engines.submit(words, shards, gpus=gpus)
    return not printed


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
