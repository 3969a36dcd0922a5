"""GPUs of this machine: which a process may use, their driver and memory."""

import os
import subprocess
from pathlib import Path

_DRIVER = Path("/proc/driver/nvidia")
_ASK_S = 20


def visible_gpus() -> tuple[str, ...]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return tuple(name.strip() for name in named.split(",") if name.strip() not in ("", "-1"))
    try:
        return tuple(str(number) for number in range(len(list((_DRIVER / "gpus").iterdir()))))
    except OSError:  # a container without that folder
        return tuple(query_gpus("index"))


def gpu_identity() -> tuple[str, ...]:
    """Return texts that change with the driver, the GPUs, or those that are visible."""
    paths = (_DRIVER / "version", *sorted((_DRIVER / "gpus").glob("*/information")))
    try:
        texts = [path.read_text(errors="replace") for path in paths]
    except OSError:
        texts = query_gpus("name,driver_version")
    return (*visible_gpus(), *texts)


def gpu_memory_bytes() -> int:
    """Return the memory of the smallest GPU of this machine; 0 where it is unknown."""
    try:
        return min(int(line) for line in query_gpus("memory.total")) << 20
    except ValueError:
        return 0


def query_gpus(fields: str) -> list[str]:
    """Return a line for each GPU with fields of nvidia-smi; none where it does not answer."""
    command = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader,nounits"]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=_ASK_S, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.strip() for line in answer.splitlines() if line.strip()]
