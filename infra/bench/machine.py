"""The machine that a figure was measured on: processor, cores, system, libraries, revision."""

import os
import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

_LIBRARIES = (
    "trilight",
    "mitsuba",
    "drjit",
    "pyoidn",
    "numpy",
    "torch",
    "pymeshlab",
    "meshoptimizer",
    "libigl",
    "OpenEXR",
    "h5py",
)


def machine(device: str = "cpu") -> dict[str, Any]:
    """Return what a figure depends on, as JSON values; with a card, `cuda`, its name too."""
    versions = {}
    for library in _LIBRARIES:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return {
        **({"card": _card()} if device == "cuda" else {}),
        "processor": processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": versions,
        "revision": revision(),
    }


def named(machine: Mapping[str, Any]) -> str:
    """Return what a machine is called beside its figures: a card before its host."""
    return ", ".join(machine[part] for part in ("card", "processor") if part in machine)


def _card() -> str:
    import torch

    return str(torch.cuda.get_device_name()) if torch.cuda.is_available() else "no card"


def processor() -> str:
    """Return the name of the processor; empty where nobody says it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def revision(root: Path = ROOT) -> str:
    """Return the commit of a checkout, with -dirty where files besides the documents differ.

    Results are documents: a run that writes them goes on as the same revision.
    """

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["git", *words], cwd=root, capture_output=True, text=True, check=False
        )

    commit = git("describe", "--always").stdout.strip()
    changed = git("diff", "--quiet", "HEAD", "--", ".", ":(exclude)docs").returncode == 1
    return f"{commit}-dirty" if changed else commit or "unknown"
