"""Where the parts of a work are made: here, as one shard of several, or on a Ray cluster."""

from __future__ import annotations

from dataclasses import dataclass


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
