"""What this device can compute: measured, not the data sheet's figure."""

import time
from functools import lru_cache

import torch

PEAK_WIDTH = {"cpu": 1024, "cuda": 8192}
"""Of the square product whose speed counts as the device's peak."""


@lru_cache
def device_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Return the operations per second of a large square product here: the best of five.

    It takes some milliseconds and then the measured value is remembered. No program reaches the
    data sheet's figure.
    """
    width = PEAK_WIDTH[device.type]
    matrix = torch.ones(width, width, dtype=dtype, device=device)
    best = float("inf")
    for _ in range(5):
        began = time.perf_counter()
        product = matrix @ matrix
        product[0, 0].item()  # waits until it is done
        best = min(best, time.perf_counter() - began)
    return 2 * width**3 / best
