"""Datasets to measure reading on: copies of a few samples, or a manifest without its shards."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.splits import named_shard
from storage.installation import IMPORT_ROOT, module_name
from storage.records.sample import sample_key

SAMPLES_PER_SHARD = 256
SUFFIXES = ("0.exr", "1.exr", "2.exr", "3.exr", "json", "scene.safetensors.gz")
MEMBER_BYTES = 25_600
"""Bytes of a member with its header: a sample of four small pictures takes about 150 kB."""

COPIES = 16
"""Keys of each sample that is copied."""
_COPIES_PER_SHARD = 16


def write_copies(root: Path, members: list[dict[str, bytes]]) -> int:
    """Write a dataset that holds each sample under COPIES keys; return how many there are."""
    folder = DatasetFolder(root)
    every = [(sample_key(k), members[k % len(members)]) for k in range(COPIES * len(members))]
    names = []
    for number, start in enumerate(range(0, len(every), _COPIES_PER_SHARD)):
        names.append(f"train-{number:06d}.tar")
        write_shard(folder.shard(names[-1]), every[start : start + _COPIES_PER_SHARD])
    _write_manifest(folder, len(every), [index_shard(folder.shard(name)) for name in names])
    return len(every)


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


class ByteServer:
    """The address of a server, and how many bytes it has sent, headers included."""

    def __init__(self) -> None:
        self.url = ""
        self.num_bytes = 0
        self._lock = threading.Lock()

    def count(self, num_bytes: int) -> None:
        """Add what was sent; called in several threads."""
        with self._lock:
            self.num_bytes += num_bytes


class _Handler(SimpleHTTPRequestHandler):
    counter: ByteServer
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        send = self.wfile.write

        def write(data: Any) -> int:
            self.counter.count(len(data))
            return send(data)

        self.wfile.write = write  # type: ignore[method-assign]

    def log_message(self, format: str, *args: object) -> None:
        """Print no line for each request."""


@contextmanager
def serve_bytes(folder: Path) -> Iterator[ByteServer]:
    """Serve a folder over HTTP on a free port of the loopback, by Python's own server."""
    counter = ByteServer()
    handler = type("Handler", (_Handler,), {"counter": counter})
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), lambda *given: handler(*given, directory=str(folder))
    ) as server:
        server.daemon_threads = True
        counter.url = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield counter
        finally:
            server.shutdown()
            thread.join()
