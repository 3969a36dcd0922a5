"""How fast shards become batches: bytes alone, decoded, by threads or processes, over HTTP.

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
from infra.bench.manifests import memory_of_opening, write_manifest_of
from infra.bench.samples import rendered_samples
from infra.bench.stream_processes import seconds_of_processes
from pipeline.flows.training_builds import smoke
from storage.layout import DatasetFolder
from storage.manifest import Manifest, index_shard, write_manifest
from storage.sample import decode_sample, decode_scene, encode_sample, sample_key
from storage.seeds import rng_for
from storage.shard_set import ShardSet
from storage.shard_writer import write_shard
from storage.training_data import TrainingData, open_training_data

if TYPE_CHECKING:
    from train.data.order import RankShare
    from train.data.scenes import TrainingScene

NAME = "streaming"
THREADS = (1, 2, 4)
PROCESSES = 2
MANIFESTS = (1_000, 100_000)
"""Samples of datasets that are opened, to see what the reader holds."""
PASSES = 4
"""Over all shards, where only bytes are read: one pass takes hundredths of a second."""
COPIES = 16
"""Keys of each rendered scene."""
PER_SHARD = 16
BATCH = 4
RESOLUTION = 64
"""Of training, from pictures of 256."""
CAT, OFF, OFF_CHECKED = "cat into a pipe", "decode off", "decode off, with hash"
APART = f"decode on, {PROCESSES} processes"
COLD, WARM, PARTS = "HTTP, cold cache", "HTTP, warm cache", "parts of a sample, one thread"
_PIPE_BYTES = 1 << 20

Figures = Mapping[str, float]


def threads_side(threads: int) -> str:
    """Return the name of the side that decodes in so many threads."""
    return f"decode on, {threads} thread{'s' if threads > 1 else ''}"


def manifest_side(num_samples: int) -> str:
    """Return the name of the side that opens a dataset of so many samples."""
    return f"opening {num_samples:,} samples"


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
        sides |= {APART: lambda: _apart(root, num_samples)}
        sides |= {COLD: lambda: _http(root, num_samples, warm=False)}
        sides |= {WARM: lambda: _http(root, num_samples, warm=True)}
        for size in MANIFESTS:
            write_manifest_of(Path(work) / str(size), size)
            sides[manifest_side(size)] = partial(memory_of_opening, Path(work) / str(size))
        return compare(NAME, sides, repeats=_repeats(options), round_done=round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return _num_scenes(options) + (7 + len(THREADS) + len(MANIFESTS)) * (1 + _repeats(options))


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
    command = ["cat", *PASSES * sorted(map(str, root.glob("*.tar")))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while data := os.read(process.stdout.fileno(), _PIPE_BYTES):
            count += len(data)
    return {"mb_per_s": count / 1e6 / (time.perf_counter() - began)}


def _bytes_only(root: Path, *, checked: bool) -> Figures:
    """Read all members of all samples, PASSES times, where the hash was looked at before.

    With the hash, every pass opens the dataset anew, as a run does that begins.
    """
    shards = open_training_data([str(root)]).split("train")
    if not checked:
        _pass_over(shards)
    count, num_samples, seconds = 0, 0, 0.0
    for _ in range(PASSES):
        if checked:
            shards = open_training_data([str(root)]).split("train")
        began = time.perf_counter()
        found = _pass_over(shards)
        seconds += time.perf_counter() - began
        count, num_samples = count + found[0], num_samples + found[1]
    return {"mb_per_s": count / 1e6 / seconds, "samples_per_s": num_samples / seconds}


def _pass_over(shards: ShardSet) -> tuple[int, int]:
    """Return the bytes of all members, and the number of samples."""
    count = num_samples = 0
    for number in range(len(shards.names)):
        with closing(shards.open(number)) as shard:
            for row in range(len(shard.keys)):
                count += sum(map(len, shard.members(row).values()))
                num_samples += 1
    return count, num_samples


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


def _apart(root: Path, num_samples: int) -> Figures:
    """Read one epoch in several processes with a thread each."""
    seconds = seconds_of_processes(_of_share, str(root), num_samples // BATCH, PROCESSES)
    return {"samples_per_s": num_samples / seconds}


def _of_share(data: str, share: "RankShare") -> "Generator[list[TrainingScene], None, None]":
    return _stream(open_training_data([data]), 1, share)


def _stream(
    data: TrainingData, threads: int, share: "RankShare | None" = None
) -> "Generator[list[TrainingScene], None, None]":
    from train.data.order import RankShare
    from train.data.stream import StreamSettings, stream_batches
    from train.data.unusable import Unusable

    settings = StreamSettings(
        seed=0, window=2, batch_size=BATCH, resolution=RESOLUTION, views_per_scene=4
    )
    return stream_batches(
        data.split("train"),
        settings,
        0,
        share=share or RankShare(),
        workers=threads,
        unusable=Unusable(0),
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
    from train.data.augment import augmented
    from train.data.scenes import training_scene
    from train.runs import smoke

    augmentation = smoke().augmentation
    spent = dict.fromkeys(("arrays_ms", "pictures_ms", "tensors_ms", "augment_ms"), 0.0)
    for number, packed in enumerate(members):
        marks = [time.thread_time()]
        key = sample_key(number)
        decode_scene(key, packed)
        marks.append(time.thread_time())
        sample = decode_sample(key, packed)
        marks.append(time.thread_time())
        scene = training_scene(sample, RESOLUTION)
        marks.append(time.thread_time())
        augmented(scene, augmentation, rng_for(0, "visit", number))
        marks.append(time.thread_time())
        for name, began, ended in zip(spent, marks, marks[1:], strict=False):
            spent[name] += 1000 * (ended - began) / len(members)
    return spent | {"pictures_ms": spent["pictures_ms"] - spent["arrays_ms"]}


def _num_scenes(options: Options) -> int:
    return 4 if options.quick else 16


def _repeats(options: Options) -> int:
    return 1 if options.quick else 3
