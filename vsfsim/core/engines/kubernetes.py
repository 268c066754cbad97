"""Kubernetes: an Indexed Job whose pods are shards of one command."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence

from vsfsim.core.errors import VsfsimError


def manifest(words: Sequence[str], shards: int, *, finish: Sequence[str], image: str = "YOUR-REGISTRY/vsfsim:latest",
             gpus: int = 0) -> str:
    """The Indexed Job of a command, for `kubectl apply -f`.

    Args:
        words: the command without --shard; its --out is an address or a volume that pods share. shards: pods. finish:
        the command that ends the work. image: with vsfsim in it. gpus: of each pod.

    Raises:
        VsfsimError: no shard.
    """
    if shards < 1:
        raise VsfsimError(f"--shards is {shards}; it must be at least 1.")
    limits = json.dumps({"cpu": "2", "memory": "8Gi", **({"nvidia.com/gpu": str(gpus)} if gpus else {})})
    return f"""# kubectl apply -f FILE; when the Job is complete: {shlex.join(finish)}
# Applied again after `kubectl delete job vsfsim`, it makes what is missing.
apiVersion: batch/v1
kind: Job
metadata: {{name: vsfsim}}
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
        image: {image}
        command: {json.dumps([*words, "--shard", f"auto/{shards}", "--workers", "2"])}
        resources: {{requests: {limits}, limits: {limits}}}
        envFrom: [{{secretRef: {{name: vsfsim-store, optional: true}}}}]   # keys of the object store
"""
