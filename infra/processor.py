"""Name of this machine's processor, which accompanies every measured time."""

import platform
from pathlib import Path


def processor() -> str:
    """Return the name of the processor; empty if the system does not state it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
