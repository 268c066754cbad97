"""Slurm: a job array whose tasks are shards of one command."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from vsfsim.core.errors import VsfsimError
from vsfsim.core.extras import missing_package

MOST = 1000
"""Tasks of an array; `MaxArraySize` is 1001 on many clusters."""


def script(words: Sequence[str], shards: int, *, finish: Sequence[str], gpus: int = 0,
           minutes: int = 240) -> str:
    """The batch files of a command: the array, and what comes after it.

    Args:
        words: the command without --shard. shards: tasks of the array. finish: the command that ends the work.
        gpus: of each task. minutes: limit of a task, which is stopped with 30 s to end and queued again.
    """
    if shards > MOST:
        raise VsfsimError(f"--shards is {shards}; a Slurm array has at most {MOST} tasks on many clusters. Give fewer: "
                          f"a shard makes several views.")
    return f"""#!/bin/bash
# Submit with: sbatch FILE; when the array is done: {shlex.join(finish)}
# The same file may be submitted again at any time: it makes what is missing.
#SBATCH --job-name=vsfsim
#SBATCH --array=0-{shards - 1}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=2
#SBATCH --mem-per-cpu=4G
#SBATCH --time={minutes}
#SBATCH --signal=TERM@30
#SBATCH --requeue
{f"#SBATCH --gpus-per-task={gpus}" if gpus else "# no GPU"}
#SBATCH --output=slurm-%A_%a.log
srun {shlex.join(words)} --shard auto --workers "$SLURM_CPUS_PER_TASK"
"""


def submit(words: Sequence[str], shards: int, folder: Path, *, gpus: int = 0, cluster: str = "slurm") -> list[str]:
    """Submit the array with submitit and wait for it; returns the messages of the shards that failed.

    Args:
        words: the command without --shard. shards: tasks of the array. folder: of the logs, which machines share.
        gpus: of each. cluster: "slurm", or "local" for processes of this machine.

    Raises:
        VsfsimError: there is no Slurm here, or too many shards. MissingPackage: submitit is not installed.
    """
    script(words, shards, finish=())
    try:
        import submitit
    except ModuleNotFoundError:
        raise missing_package("submitit", "slurm") from None
    try:
        executor = submitit.AutoExecutor(folder=str(folder), cluster=cluster)
        executor.update_parameters(timeout_min=240, cpus_per_task=2, name="vsfsim",
                                   **({"gpus_per_node": gpus} if gpus else {}))
    except RuntimeError as error:
        raise VsfsimError(f"there is no Slurm on this machine ({error}). Use --print to write the batch file, and "
                          f"submit it where `sbatch` is.") from None
    with executor.batch():
        jobs = [executor.submit(submitit.helpers.CommandFunction([*words, "--shard", f"{k}/{shards}"], verbose=False))
                for k in range(shards)]
    return [f"shard {k}/{shards}: {str(failed).strip().splitlines()[-1]}" for k, job in enumerate(jobs)
            if (failed := job.exception()) is not None]
