"""Description and throughput of a device: matrix products by type, and memory copies."""

import time
from collections.abc import Callable

import torch

from model.precision import fast_float32_products
from pipeline.renders.visible_gpus import query_gpus

REPEATS = 5


def device_facts(device: torch.device) -> str:
    """Return a line on a device: memory, libraries, driver, without a serial number."""
    if device.type != "cuda":
        return f"no GPU: torch {torch.__version__} with {torch.get_num_threads()} threads"
    properties = torch.cuda.get_device_properties(device)
    driver = next(iter(query_gpus("driver_version")), "unknown")
    return (
        f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, torch {torch.__version__}, "
        f"CUDA {torch.version.cuda}, driver {driver}"
    )


def product_figures(device: torch.device, kind: str, width: int) -> dict[str, float]:
    """Return the seconds and FLOP/s of a large square matrix product: the best of five.

    Args:
        device: device of the product.
        kind: float32, tf32, bfloat16 or float16.
        width: width of the matrices.
    """
    dtype = torch.float32 if kind == "tf32" else getattr(torch, kind)
    matrix = torch.randn(width, width, device=device).to(dtype)
    with fast_float32_products(device, enabled=kind == "tf32"):
        seconds = min(time_calls(lambda: matrix @ matrix, device))
    return {"ms": 1e3 * seconds, "teraflop_per_s": 2 * width**3 / seconds / 1e12}


def copy_figures(device: torch.device, kind: str, size: int) -> dict[str, float]:
    """Return the seconds and bytes a second of a copy.

    Args:
        device: device of the copy.
        kind: within (bytes read and written count), to_pageable or to_pinned.
        size: number of bytes to copy.
    """
    target = torch.zeros(size, dtype=torch.uint8, device=device)
    if kind == "within":
        source = torch.zeros(size, dtype=torch.uint8, device=device)
    else:
        source = torch.zeros(size, dtype=torch.uint8)
        source = source.pin_memory() if kind == "to_pinned" else source
    non_blocking = kind == "to_pinned"
    seconds = min(time_calls(lambda: target.copy_(source, non_blocking=non_blocking), device))
    moved = 2 * size if kind == "within" else size
    return {"ms": 1e3 * seconds, "gigabyte_per_s": moved / seconds / 1e9}


def time_calls(
    work: Callable[[], object], device: torch.device, repeats: int = REPEATS, *, warm_up: int = 1
) -> list[float]:
    """Return the seconds of several calls until the device is done, after some that warm it up."""
    times = []
    for _ in range(warm_up + repeats):
        began = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - began)
    return times[warm_up:]
