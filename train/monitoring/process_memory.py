"""Memory use of a training process."""

import os
from pathlib import Path

import torch

_STATM = Path("/proc/self/statm")


def memory_mb(device: torch.device) -> dict[str, float]:
    """Return memory use in megabytes (1e6 bytes) by name.

    `process`: resident memory of the process, shared libraries included; on Linux only.
    `device_peak`: peak of the tensors on a GPU since the last call, from the host's own counts.
    """
    megabytes = {}
    if _STATM.exists():
        pages = int(_STATM.read_text().split()[1])
        megabytes["process"] = round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
    if device.type == "cuda" and torch.cuda.is_initialized():
        megabytes["device_peak"] = round(torch.cuda.max_memory_allocated(device) / 1e6, 1)
        torch.cuda.reset_peak_memory_stats(device)
    return megabytes
