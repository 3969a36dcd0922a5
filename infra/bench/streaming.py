"""How fast shards become batches: bytes alone, decoded, by threads, and over HTTP.

On rendered scenes of `smoke` in the profile `compact`, each under many keys, so that there are
enough bytes. They lie in memory before a side begins: the disk is not measured. The server is
Python's own on the same machine, so that over HTTP the bytes are figures and the times are not.
"""

import itertools
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from infra.bench.byte_server import serve_bytes
from infra.bench.harness import Comparison, Options, compare
from infra.bench.samples import rendered_samples
from pipeline.flows.training_builds import smoke
from storage.layout import DatasetFolder
from storage.manifest import Manifest, index_shard, write_manifest
from storage.sample import decode_sample, encode_sample, sample_key
from storage.shard_writer import write_shard
from storage.training_data import TrainingData, open_training_data

if TYPE_CHECKING:
    from train.data.scenes import TrainingScene

NAME = "streaming"
THREADS = (1, 2, 4)
COPIES = 16
"""Keys of each rendered scene."""
PER_SHARD = 16
BATCH = 4
CAT, OFF, OFF_CHECKED = "cat into a pipe", "decode off", "decode off, with hash"
COLD, WARM, PARTS = "HTTP, cold cache", "HTTP, warm cache", "parts of a sample, one thread"
_PIPE_BYTES = 1 << 20

Figures = Mapping[str, float]


def threads_side(threads: int) -> str:
    """Return the name of the side that decodes in so many threads."""
    return f"decode on, {threads} thread{'s' if threads > 1 else ''}"


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly 4 scenes once, otherwise 16 scenes three times."""
    samples = rendered_samples(smoke(), options, _num_scenes(options), round_done)
    members = [encode_sample(sample, "compact") for sample in samples]
    with tempfile.TemporaryDirectory() as work:
        root = Path(work) / "set"
        num_samples = write_copies(root, members)
        sides: dict[str, Callable[[], Figures]] = {
            CAT: lambda: _cat(root),
            OFF: lambda: _bytes_only(root, checked=False),
            OFF_CHECKED: lambda: _bytes_only(root, checked=True),
            PARTS: lambda: _parts(members),
        }
        for threads in THREADS:
            sides[threads_side(threads)] = partial(_local, root, num_samples, threads)
        sides |= {COLD: lambda: _http(root, num_samples, warm=False)}
        sides |= {WARM: lambda: _http(root, num_samples, warm=True)}
        return compare(NAME, sides, repeats=_repeats(options), round_done=round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return _num_scenes(options) + (6 + len(THREADS)) * (1 + _repeats(options))


def write_copies(root: Path, members: list[dict[str, bytes]]) -> int:
    """Write each sample under COPIES keys; returns how many samples there are."""
    folder = DatasetFolder(root)
    every = [(sample_key(k), members[k % len(members)]) for k in range(COPIES * len(members))]
    names = []
    for number, start in enumerate(range(0, len(every), PER_SHARD)):
        names.append(f"train-{number:06d}.tar")
        write_shard(folder.shard(names[-1]), every[start : start + PER_SHARD])
    manifest = Manifest(
        build=NAME,
        settings={},
        environment={},
        num_scenes=len(every),
        num_views=4,
        objects_lock_sha256="",
        shards=tuple(index_shard(folder.shard(name)) for name in names),
    )
    write_manifest(folder.manifest, manifest)
    return len(every)


def _cat(root: Path) -> Figures:
    began, count = time.perf_counter(), 0
    command = ["cat", *map(str, sorted(root.glob("*.tar")))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while data := os.read(process.stdout.fileno(), _PIPE_BYTES):
            count += len(data)
    return {"mb_per_s": count / 1e6 / (time.perf_counter() - began)}


def _bytes_only(root: Path, *, checked: bool) -> Figures:
    """Read all members of all samples, once where the hash was looked at before."""
    shards = open_training_data([str(root)]).split("train")
    began, count, num_samples = time.perf_counter(), 0, 0
    for timed in (True,) if checked else (False, True):
        if timed:
            began, count, num_samples = time.perf_counter(), 0, 0
        for number in range(len(shards.names)):
            with closing(shards.open(number)) as shard:
                for row in range(len(shard.keys)):
                    count += sum(map(len, shard.members(row).values()))
                    num_samples += 1
    seconds = time.perf_counter() - began
    return {"mb_per_s": count / 1e6 / seconds, "samples_per_s": num_samples / seconds}


def _local(root: Path, num_samples: int, threads: int) -> Figures:
    return _batches(open_training_data([str(root)]), num_samples, threads)


def _batches(data: TrainingData, num_samples: int, threads: int) -> Figures:
    """Read one epoch as training does, but for the network."""
    began, first = time.perf_counter(), 0.0
    with closing(_stream(data, threads)) as batches:
        for _ in itertools.islice(batches, num_samples // BATCH):
            first = first or time.perf_counter() - began
    seconds = time.perf_counter() - began
    return {"samples_per_s": num_samples / seconds, "first_batch_s": first}


def _stream(data: TrainingData, threads: int) -> "Generator[list[TrainingScene], None, None]":
    from train.data.order import Share
    from train.data.stream import StreamSettings, stream_batches
    from train.data.unusable import Unusable

    settings = StreamSettings(seed=0, window=2, batch_size=BATCH, resolution=64, views_per_scene=4)
    return stream_batches(
        data.split("train"), settings, 0, share=Share(), workers=threads, unusable=Unusable(0)
    )


def _http(root: Path, num_samples: int, *, warm: bool) -> Figures:
    with serve_bytes(root) as server, _own_cache():
        if warm:
            _batches(open_training_data([server.url]), num_samples, 1)
        before = server.num_bytes
        figures = _batches(open_training_data([server.url]), num_samples, 1)
        on_wire = server.num_bytes - before
    members = sum(path.stat().st_size for path in root.glob("*.tar"))
    return {
        **figures,
        "wire_bytes_per_sample": on_wire / num_samples,
        "bytes_per_sample": members / num_samples,
    }


@contextmanager
def _own_cache() -> Iterator[None]:
    """Keep shards of servers in a folder of their own, and ask no proxy for the loopback."""
    with tempfile.TemporaryDirectory() as folder:
        changes = {"TRILIGHT_CACHE": folder, "NO_PROXY": "127.0.0.1"}
        before = {name: os.environ.get(name) for name in changes}
        os.environ.update(changes)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _parts(members: list[dict[str, bytes]]) -> Figures:
    """Return processor time of one thread by what it is spent on, per sample."""
    from train.data.scenes import training_scene

    decode = make = 0.0
    for number, packed in enumerate(members):
        began = time.thread_time()
        sample = decode_sample(sample_key(number), packed)
        decoded = time.thread_time()
        training_scene(sample, 64)
        decode, make = decode + decoded - began, make + time.thread_time() - decoded
    return {"decode_ms": 1000 * decode / len(members), "tensors_ms": 1000 * make / len(members)}


def _num_scenes(options: Options) -> int:
    return 4 if options.quick else 16


def _repeats(options: Options) -> int:
    return 1 if options.quick else 3
