"""Time and memory of work on a torch device."""

from __future__ import annotations

import torch

from vsfsim.core.system.process_memory import held_memory, peak_memory


def wait(device: str) -> None:
    """Return when the device has done all that was asked of it."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def start_memory(device: str) -> float:
    """Memory held now [MiB]: of the process, or on a GPU; the peak counts from here."""
    if torch.device(device).type != "cuda":
        return held_memory(reset=True)
    torch.cuda.init()  # without it there is no device whose peak could be reset
    torch.cuda.reset_peak_memory_stats(device)
    return torch.cuda.memory_allocated(device) / 2**20


def most_memory(device: str) -> float:
    """Largest memory held since `start_memory` [MiB]."""
    return peak_memory() if torch.device(device).type != "cuda" else torch.cuda.max_memory_allocated(device) / 2**20
