"""How fast a dataset is read by `dataset.torch()`: items and megabytes a second, and the memory, by number of workers.

A dataset may be larger than memory: each process keeps `vsfsim.data.torch_view.KEPT` object views and no more.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch.utils.data

from vsfsim.data.dataset import Dataset


def measure(folder: Path, workers: Sequence[int], *, item: str = "touch",
            shuffle: bool = False) -> list[dict[str, Any]]:
    """Read a dataset once for each number of workers.

    Args:
        folder: of the dataset. workers: processes that read, 0 for this one. item: "touch" or "view". shuffle: whether
        in random order, which reads the file of a touch again and again.

    Returns:
        One row a number: items, seconds on the clock, items and MB a second, and the peak memory [MB] of this process
        and of its largest worker.

    Raises:
        DatasetError: no finished dataset there, or another kind of item.
    """
    dataset = Dataset.open(folder)
    size = sum(entry.bytes for entry in dataset.entries) / 1e6
    rows = []
    for count in workers:
        view = dataset.torch(item)
        loader = torch.utils.data.DataLoader(view, batch_size=4, num_workers=count, collate_fn=view.collate,
                                             shuffle=shuffle, generator=torch.Generator().manual_seed(0))
        began, items = time.perf_counter(), 0
        for batch in loader:
            items += len(batch["name"])
        seconds = time.perf_counter() - began
        who = resource.RUSAGE_CHILDREN if count else resource.RUSAGE_SELF
        rows.append({"workers": count, "items": items, "seconds": seconds, "items_per_s": items / seconds,
                     "MB_per_s": size / seconds, "peak_MB": resource.getrusage(who).ru_maxrss / 1e3})
    return rows


def text(rows: Sequence[dict[str, Any]]) -> str:
    """As a table."""
    lines = [f"{'workers':>8}{'items':>8}{'s':>8}{'items/s':>10}{'MB/s':>8}{'peak MB':>9}"]
    lines += [f"{r['workers']:>8}{r['items']:>8}{r['seconds']:>8.2f}{r['items_per_s']:>10.1f}{r['MB_per_s']:>8.1f}"
              f"{r['peak_MB']:>9.0f}" for r in rows]
    return "\n".join(lines)
