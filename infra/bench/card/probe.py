"""What the card is, and what it reaches: products by type, copies within it and to it."""

import shutil
import subprocess
import time
from collections.abc import Callable
from typing import Any

import torch

from infra.bench.card.effort import CardEffort
from model.precision import quick_products

_ASKED = ("driver_version", "memory.total", "power.limit", "clocks.max.sm", "clocks.max.mem")
"""What nvidia-smi is asked for; neither a serial number nor an identifier is."""
_ANSWER_S = 60
REPEATS = 5


def card_facts(device: torch.device) -> dict[str, Any]:
    """Return what a device is called and has; of a processor the name alone.

    Numbers of nvidia-smi are as it prints them: MiB, W, MHz.
    """
    if device.type != "cuda":
        return {"name": "none", "torch": torch.__version__, "threads": torch.get_num_threads()}
    found = torch.cuda.get_device_properties(device)
    return {
        "name": found.name,
        "memory_gib": found.total_memory / 2**30,
        "capability": f"{found.major}.{found.minor}",
        "multiprocessors": found.multi_processor_count,
        "cards": torch.cuda.device_count(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "cudnn": torch.backends.cudnn.version(),
        "nvidia_smi": _asked_of_smi(device.index or 0),
    }


def _asked_of_smi(index: int) -> dict[str, str]:
    smi = shutil.which("nvidia-smi")
    if smi is None:
        return {}
    command = [smi, f"--id={index}", f"--query-gpu={','.join(_ASKED)}"]
    try:
        told = subprocess.run(
            [*command, "--format=csv,noheader,nounits"],
            capture_output=True,
            text=True,
            timeout=_ANSWER_S,
            check=True,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return {}
    return dict(zip(_ASKED, (value.strip() for value in told.split(",")), strict=False))


def product_rates(device: torch.device, effort: CardEffort) -> dict[str, float]:
    """Return FLOPs a second of a large square product by type: the best of five.

    TF32 and float16 are measured on a card alone, and bfloat16 on a processor that has products
    of it.
    """
    width = effort.product_width
    rates = {"float32": _rate(device, torch.float32, width)}
    if device.type == "cuda":
        with quick_products(device, wanted=True):
            rates["tf32"] = _rate(device, torch.float32, width)
        rates["bfloat16"] = _rate(device, torch.bfloat16, width)
        rates["float16"] = _rate(device, torch.float16, width)
    return rates


def _rate(device: torch.device, dtype: torch.dtype, width: int) -> float:
    matrix = torch.randn(width, width, device=device).to(dtype)
    return 2 * width**3 / best_s(lambda: matrix @ matrix, device)


def copy_rates(device: torch.device, effort: CardEffort) -> dict[str, float]:
    """Return bytes a second: `within` counts what is read and written, `to` what arrives."""
    size = effort.copied_mib << 20
    source, target = (torch.zeros(size, dtype=torch.uint8, device=device) for _ in range(2))
    rates = {"within": 2 * size / best_s(lambda: target.copy_(source), device)}
    if device.type == "cuda":
        host = torch.zeros(size, dtype=torch.uint8)
        rates["to_pageable"] = size / best_s(lambda: target.copy_(host), device)
        pinned = host.pin_memory()
        rates["to_pinned"] = size / best_s(lambda: target.copy_(pinned, non_blocking=True), device)
    return rates


def best_s(work: Callable[[], object], device: torch.device, repeats: int = REPEATS) -> float:
    """Return the seconds of the quickest of some calls, after one that is not counted."""
    work()
    wait_for(device)
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        wait_for(device)
        times.append(time.perf_counter() - began)
    return min(times)


def wait_for(device: torch.device) -> None:
    """Wait until a device has done all that it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
