"""Manifests of datasets of any size without their shards, and what opening one takes."""

import subprocess
import sys
from pathlib import Path

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, write_manifest
from storage.dataset.splits import named_shard
from storage.installation import IMPORT_ROOT, module_name

SAMPLES_PER_SHARD = 256
SUFFIXES = ("0.exr", "1.exr", "2.exr", "3.exr", "json", "scene.safetensors.gz")
MEMBER_BYTES = 25_600
"""Bytes of a member with its header: a sample of four small pictures takes about 150 kB."""


def write_manifest_of(root: Path, num_samples: int) -> None:
    """Write the manifest of a dataset whose every scene is for training."""
    shards = [
        _shard(number, range(first, min(first + SAMPLES_PER_SHARD, num_samples)))
        for number, first in enumerate(range(0, num_samples, SAMPLES_PER_SHARD))
    ]
    _write_manifest(DatasetFolder(root), num_samples, shards)


def _write_manifest(folder: DatasetFolder, num_samples: int, shards: list[ShardEntry]) -> None:
    manifest = Manifest(
        build="bench", settings={}, environment={}, num_scenes=num_samples, num_views=4,
        objects_lock_sha256="", shards=tuple(shards),
    )  # fmt: skip
    write_manifest(folder.manifest, manifest)


def _shard(number: int, indices: range) -> ShardEntry:
    return ShardEntry(
        name=named_shard(number, "train"),
        split="train",
        num_samples=len(indices),
        num_bytes=len(indices) * len(SUFFIXES) * MEMBER_BYTES + 10_240,
        sha256=f"{number:064x}",
    )


def memory_of_opening(root: Path) -> dict[str, float]:
    """Open a dataset for training in a fresh process; returns what it takes and how long.

    `peak_bytes` is what the process grows by at most, `held_bytes` what of it stays.
    """
    module = module_name("storage.dataset.training_data")
    command = [sys.executable, "-c", _CHILD, str(root), module]
    ran = subprocess.run(command, cwd=IMPORT_ROOT, capture_output=True, text=True, check=True)
    peak, held, seconds = map(float, ran.stdout.split())
    return {"peak_bytes": peak, "held_bytes": held, "open_s": seconds}


_CHILD = """
import sys, time
from importlib import import_module
open_training_data = import_module(sys.argv[2]).open_training_data
def now(name):
    # not getrusage: its peak counts the parent too, from before this program was begun
    lines = open("/proc/self/status").read().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))
peak, held, began = now("VmHWM"), now("VmRSS"), time.perf_counter()
data = open_training_data([sys.argv[1]])
seconds = time.perf_counter() - began
print(now("VmHWM") - peak, now("VmRSS") - held, seconds)
"""
