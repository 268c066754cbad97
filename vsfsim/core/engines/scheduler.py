"""Slurm and Kubernetes: the file of a command whose tasks are its shards, and Slurm's array by submitit."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from vsfsim.core.errors import VsfsimError
from vsfsim.core.extras import missing_package

MOST = 1000
"""Tasks of a Slurm array; `MaxArraySize` is 1001 on many clusters."""
IMAGE = "YOUR-REGISTRY/vsfsim:latest"
"""Of the repository's Dockerfile, which has the package with its extras `all` and `cloud`."""


def job_file(engine: str, words: Sequence[str], shards: int, *, finish: Sequence[str], gpus: int = 0) -> str:
    """The file for `sbatch` or `kubectl apply -f`.

    Args:
        engine: "slurm" or "k8s". words: the command without --shard. shards: tasks. finish: the command that ends the
        work. gpus: of each task.

    Raises:
        VsfsimError: too many shards, a word with a control character, or for Kubernetes a path of this machine.
    """
    odd = [word for word in words if not word.isprintable()]
    if odd:
        raise VsfsimError(f"{odd[0]!r} has a character that ends a line of a job's file. Rename what it names.")
    return (_batch if engine == "slurm" else _manifest)(words, shards, shlex.join(finish), gpus)


def _batch(words: Sequence[str], shards: int, finish: str, gpus: int) -> str:
    if shards > MOST:
        raise VsfsimError(f"--shards is {shards}; a Slurm array has at most {MOST} tasks on many clusters. Give fewer: "
                          f"a shard makes several views.")
    return f"""#!/bin/bash
# Submit with: sbatch FILE; when the array is done: {finish}
# The same file may be submitted again at any time: it makes what is missing.
#SBATCH --job-name=vsfsim
#SBATCH --array=0-{shards - 1}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=2
#SBATCH --mem-per-cpu=4G
#SBATCH --time=240
#SBATCH --signal=TERM@30
#SBATCH --requeue
{f"#SBATCH --gpus-per-task={gpus}" if gpus else "# no GPU"}
#SBATCH --output=slurm-%A_%a.log
srun {shlex.join(words)} --shard auto --workers "$SLURM_CPUS_PER_TASK"
"""


def _manifest(words: Sequence[str], shards: int, finish: str, gpus: int) -> str:
    here = [word for word in words if os.path.isabs(word.partition("=")[2] or word) or word.startswith("~")]
    if here:
        raise VsfsimError(f"'{here[0]}' is a path of this machine, which a pod does not have. Give the address of an "
                          f"object store (s3://...), or a path in the volume of the claim 'vsfsim', relative to it: "
                          f"pods work in that folder.")
    # a name is a DNS label: small letters, digits and dashes, 63 at most; another command is another job
    name = f"vsfsim-{hashlib.sha256(shlex.join(words).encode()).hexdigest()[:10]}"
    limits = json.dumps({"cpu": "2", "memory": "8Gi", **({"nvidia.com/gpu": str(gpus)} if gpus else {})})
    volume = "" if any("://" in word for word in words) else """
        workingDir: /work
        volumeMounts: [{name: work, mountPath: /work}]
      volumes: [{name: work, persistentVolumeClaim: {claimName: vsfsim}}]   # read and written by all pods"""
    return f"""# kubectl apply -f FILE; when the Job is complete: {finish}
# Applied again after `kubectl delete job {name}`, it makes what is missing.
apiVersion: batch/v1
kind: Job
metadata: {{name: {name}}}
spec:
  completionMode: Indexed
  completions: {shards}
  parallelism: {shards}
  backoffLimitPerIndex: 6
  maxFailedIndexes: {shards}
  template:
    spec:
      restartPolicy: Never
      terminationGracePeriodSeconds: 30
      containers:
      - name: vsfsim
        image: {IMAGE}
        command: {json.dumps([*words, "--shard", f"auto/{shards}", "--workers", "2"])}
        resources: {{requests: {limits}, limits: {limits}}}
        envFrom: [{{secretRef: {{name: vsfsim-store, optional: true}}}}]   # keys of the object store{volume}
"""


def submit(words: Sequence[str], shards: int, folder: Path, *, gpus: int = 0, cluster: str = "slurm") -> list[str]:
    """Submit the array with submitit and wait for it; returns the messages of the shards that failed.

    Args:
        words: the command without --shard. shards: tasks of the array. folder: of the logs, which machines share.
        gpus: of each. cluster: "slurm", or "local" for processes of this machine.

    Raises:
        VsfsimError: there is no Slurm here, or too many shards. MissingPackage: submitit is not installed.
    """
    job_file("slurm", words, shards, finish=())
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
