"""Where the parts of a work are made, and which of them this process makes: shard i of n, given or read from what a
scheduler says."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

from vsfsim.core.errors import VsfsimError

MOST = 100_000
"""Shards of one work."""


@dataclass(frozen=True)
class Fan:
    """The default is this machine, by itself."""

    shard: tuple[int, int] | None = None
    """(i, n): only the i-th of n shares of the parts, from 0; whoever runs the work without it ends it."""
    ray: str = ""
    """Address of a Ray cluster that makes the parts; "" for none."""
    gpus: float = 0.0
    """GPUs of each of its tasks [1]."""


HERE = Fan()


def shard_of(given: str, environment: Mapping[str, str] | None = None) -> tuple[int, int]:
    """(i, n) of ``--shard``: the i-th of n shards, from 0.

    Args:
        given: "i/n"; "auto" for index and number of a Slurm job array; "auto/n" for the index of an array or of a
            Kubernetes Indexed Job, which does not tell its number.
        environment: of the process, None for this one's.

    Raises:
        VsfsimError: another text, i is not below n, or the environment says nothing.
    """
    env = os.environ if environment is None else environment
    allowed = ("Allowed: i/n with 0 <= i < n, e.g. 0/4 to 3/4; auto in a Slurm job array; auto/n there or in a "
               "Kubernetes Indexed Job.")
    match = re.fullmatch(r"(?:(\d{1,9})|auto)(?:/(\d{1,9}))?", given)
    if match is None or (match[1] is not None and match[2] is None):
        raise VsfsimError(f"--shard is '{given}'. {allowed}")
    if match[1] is not None:
        index = int(match[1])
    elif "SLURM_ARRAY_TASK_ID" in env:
        index = _number(env, "SLURM_ARRAY_TASK_ID") - _number(env, "SLURM_ARRAY_TASK_MIN", "0")
    elif "JOB_COMPLETION_INDEX" in env:
        index = _number(env, "JOB_COMPLETION_INDEX")
    else:
        raise VsfsimError(f"--shard is '{given}', but neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is set: "
                          f"this is no task of a job array. {allowed}")
    if match[2] is not None:
        count = int(match[2])
    elif "SLURM_ARRAY_TASK_COUNT" in env:
        count = _number(env, "SLURM_ARRAY_TASK_COUNT")
    else:
        raise VsfsimError(f"--shard is '{given}', but the environment does not say how many shards there are. "
                          f"{allowed}")
    if not 0 <= index < count <= MOST:
        raise VsfsimError(f"--shard is {index}/{count}. {allowed}")
    return index, count


def _number(env: Mapping[str, str], name: str, default: str = "") -> int:
    text = env.get(name, default)
    if not text.isdecimal():
        raise VsfsimError(f"the environment variable {name} is '{text}'; it must be a whole number.")
    return int(text)
