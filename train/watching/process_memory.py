"""Memory of a training process."""

import os
from pathlib import Path

import torch

_STATM = Path("/proc/self/statm")


def memory_mb(device: torch.device) -> dict[str, float]:
    """Return megabytes (1e6 bytes) by what they are.

    `process`: what the process holds now, shared libraries included; on Linux alone.
    `device_peak`: the most that tensors held on a card since the last call; the host has counted
    them, so the card is not asked.
    """
    found = {}
    if _STATM.exists():
        pages = int(_STATM.read_text().split()[1])
        found["process"] = round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
    if device.type == "cuda" and torch.cuda.is_initialized():
        found["device_peak"] = round(torch.cuda.max_memory_allocated(device) / 1e6, 1)
        torch.cuda.reset_peak_memory_stats(device)
    return found
