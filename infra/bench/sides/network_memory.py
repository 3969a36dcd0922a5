"""Peak memory of a forward pass beyond its weights, in a process of its own.

On a CPU the process's own peak is read, with what the libraries take besides torch; on CUDA the
allocator's. Inputs count: the published network's textures are a part of what it needs.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from infra.bench.sides.networks import Contenders
from model.costs import Workload
from model.published.config import PublishedConfig, decode_published, encode_published
from storage.errors import TrilightError
from storage.installation import IMPORT_ROOT, module_name

_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peaks_of(
    side: str, config: PublishedConfig, workloads: Sequence[Workload], device: torch.device
) -> list[int]:
    """Return the bytes that each workload adds to the weights at most, measured in a child.

    Raises:
        TrilightError: the child failed.
    """
    order = {
        "side": side,
        "device": str(device),
        "config": encode_published(config),
        "workloads": [asdict(workload) for workload in workloads],
    }
    ran = subprocess.run(
        [sys.executable, "-m", module_name("infra.bench.sides.network_memory")],
        input=json.dumps(order),
        cwd=IMPORT_ROOT,
        # freed blocks go back at once, or the next peak would start from what the last one left
        env={**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"},
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode:
        raise TrilightError(f"bench: the memory of {side} was not measured: {ran.stderr}")
    peaks: list[int] = json.loads(ran.stdout)
    return peaks


@torch.inference_mode()
def _measure(order: dict[str, object]) -> list[int]:
    config = decode_published(order["config"])  # type: ignore[arg-type]
    device, side = torch.device(str(order["device"])), str(order["side"])
    workloads = [Workload(**fields) for fields in order["workloads"]]  # type: ignore[attr-defined]
    contenders = Contenders(config, (side,), device)
    small = Workload(triangles=16, views=1, resolution=config.model.picture_px)
    contenders.prepared(side, small)()  # threads and libraries begin here
    return [_peak(contenders, side, workload, device) for workload in workloads]


def _peak(contenders: Contenders, side: str, workload: Workload, device: torch.device) -> int:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        contenders.prepared(side, workload)()
        return torch.cuda.max_memory_allocated(device) - before
    before = _status("VmRSS")
    _FORGET.write_text("5")  # the peak starts anew
    contenders.prepared(side, workload)()
    return _status("VmHWM") - before


def _status(name: str) -> int:
    lines = _STATUS.read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_measure(json.load(sys.stdin))))
