"""How fast shards become batches: bytes alone, decoded, by threads or processes, over HTTP.

On rendered scenes of `smoke` in the profile `compact`, each under many keys, so that there are
enough bytes. They lie in memory before a point begins: the disk is not measured. The server is
Python's own on the same machine, so that over HTTP the bytes are figures and the times are not.
"""

import itertools
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, repeats
from infra.bench.sides.stream_processes import seconds_of_processes
from infra.bench.subjects.manifests import (
    memory_of_opening,
    serve_bytes,
    write_copies,
    write_manifest_of,
)
from infra.bench.workshop import Workshop
from storage.dataset.shard_set import ShardSet
from storage.dataset.training_data import TrainingData, open_training_data
from storage.records.sample import decode_sample, decode_scene, encode_sample, sample_key
from storage.seeds import rng_for

if TYPE_CHECKING:
    from train.data.order import RankShare
    from train.data.scenes import TrainingScene

THREADS, PROCESSES = (1, 2, 4), 2
MANIFESTS = (1_000, 100_000)
"""Samples of datasets that are opened, to see what the reader holds."""
PASSES = 4
"""Passes over all shards where only bytes are read: one takes hundredths of a second."""
BATCH, RESOLUTION = 4, 64
"""Scenes of a batch, and pixels across its pictures, which are reduced from 256."""
_PIPE_BYTES = 1 << 20

Dataset = tuple[Path, int, list[dict[str, bytes]]]
"""A folder of shards, its samples, and the members that they repeat."""


def _dataset(workshop: Workshop) -> Dataset:
    def made() -> Dataset:
        members = [encode_sample(sample, "compact") for sample in workshop.samples]
        root = workshop.folder() / "set"
        return root, write_copies(root, members), members

    return workshop.kept("dataset", made)


def _cat(dataset: Dataset) -> Figures:
    began, count = time.perf_counter(), 0
    command = ["cat", *PASSES * sorted(map(str, dataset[0].glob("*.tar")))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while data := os.read(process.stdout.fileno(), _PIPE_BYTES):
            count += len(data)
    return {"sample_s": (time.perf_counter() - began) / PASSES / dataset[1], "bytes": count}


def _bytes_only(dataset: Dataset, *, checked: bool) -> Figures:
    """Read all members of all samples, PASSES times, where the hash was looked at before.

    With the hash, every pass opens the dataset anew, as a run does that begins.
    """
    shards = open_training_data([str(dataset[0])]).split("train")
    if not checked:
        _pass_over(shards)
    count, seconds = 0, 0.0
    for _ in range(PASSES):
        if checked:
            shards = open_training_data([str(dataset[0])]).split("train")
        began = time.perf_counter()
        count += _pass_over(shards)
        seconds += time.perf_counter() - began
    return {"sample_s": seconds / PASSES / dataset[1], "bytes": count}


def _pass_over(shards: ShardSet) -> int:
    """Return the bytes of all members."""
    count = 0
    for number in range(len(shards.names)):
        with closing(shards.open(number)) as shard:
            for row in range(len(shard.keys)):
                count += sum(map(len, shard.members(row).values()))
    return count


def _threads(dataset: Dataset, threads: int) -> Figures:
    return _batches(open_training_data([str(dataset[0])]), dataset[1], threads)


def _batches(data: TrainingData, num_samples: int, threads: int) -> Figures:
    """Read one epoch as training does, but for the network."""
    began, first = time.perf_counter(), 0.0
    with closing(_stream(data, threads)) as batches:
        for _ in itertools.islice(batches, num_samples // BATCH):
            first = first or time.perf_counter() - began
    return {"sample_s": (time.perf_counter() - began) / num_samples, "first_s": first}


def _apart(dataset: Dataset) -> Figures:
    """Read one epoch in several processes with a thread each."""
    root, num_samples, _ = dataset
    seconds = seconds_of_processes(_of_share, str(root), num_samples // BATCH, PROCESSES)
    return {"sample_s": seconds / num_samples}


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


def _http(dataset: Dataset, *, warm: bool) -> Figures:
    root, num_samples, _ = dataset
    with serve_bytes(root) as server, _own_cache():
        if warm:
            _batches(open_training_data([server.url]), num_samples, 1)
        before = server.num_bytes
        figures = _batches(open_training_data([server.url]), num_samples, 1)
        on_wire = server.num_bytes - before
    return {**figures, "wire": on_wire / num_samples}


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


SIDES: dict[str, Callable[[Dataset], Figures]] = {
    "cat into a pipe": _cat,
    "decode off": partial(_bytes_only, checked=False),
    "decode off, with hash": partial(_bytes_only, checked=True),
    **{f"{count} threads": partial(_threads, threads=count) for count in THREADS},
    f"{PROCESSES} processes": _apart,
    "HTTP, cold cache": partial(_http, warm=False),
    "HTTP, warm cache": partial(_http, warm=True),
}


def _parts(members: list[dict[str, bytes]]) -> dict[str, float]:
    """Return processor time of one thread by what it is spent on, milliseconds a sample."""
    from train.data.augment import augmented
    from train.data.scenes import training_scene
    from train.runs import smoke

    augmentation = smoke().augmentation
    spent = dict.fromkeys(("arrays", "arrays and pictures", "tensors", "augmentation"), 0.0)
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
    return spent


def _part(workshop: Workshop, point: Point, turn: str) -> Figures:
    found = workshop.kept(("parts", turn), lambda: _parts(_dataset(workshop)[2]))
    return {"ms": found[point.name]}


def _opening(workshop: Workshop, point: Point, turn: str) -> Figures:
    def written() -> Path:
        root = workshop.folder() / "manifest"
        write_manifest_of(root, point.settings)
        return root

    return memory_of_opening(workshop.kept(point.name, written))


def _mega(value: float) -> float:
    return value / 1e6


EXPERIMENTS = (
    Experiment(
        name="streaming",
        title="Reading shards",
        about="Shards in memory read as bytes, decoded to tensors of 64 pixels and augmented.",
        cost=Column(name="seconds a sample, on the clock", figure="sample_s"),
        columns=(
            Column(name="samples a second", figure="sample_s", then=lambda s: 1 / s),
            Column(name="first batch after, s", figure="first_s"),
            Column(name="bytes on the wire a sample", figure="wire"),
        ),
        points=lambda effort: [Point(name=name) for name in SIDES],
        turns=repeats,
        measure=one_by_one(lambda workshop, point, turn: SIDES[point.name](_dataset(workshop))),
        warm_up=True,
        needs=("torch",),
    ),
    Experiment(
        name="sample-parts",
        title="What a sample's processor time is spent on",
        about=(
            "Processor time of one thread, from the bytes of a sample to an augmented sample "
            "of 64 pixels."
        ),
        cost=Column(name="ms a sample", figure="ms"),
        points=lambda effort: [
            Point(name=name)
            for name in ("arrays", "arrays and pictures", "tensors", "augmentation")
        ],
        turns=repeats,
        measure=one_by_one(_part),
        warm_up=True,
        needs=("torch",),
    ),
    Experiment(
        name="opening",
        title="Memory of opening a dataset",
        about="A manifest without shards, opened for training in a fresh process.",
        cost=Column(name="MB at most", figure="peak_bytes", then=_mega),
        columns=(
            Column(name="MB held", figure="held_bytes", then=_mega),
            Column(name="seconds", figure="open_s"),
        ),
        points=lambda effort: [
            Point(name=f"{count:,} samples", settings=count) for count in MANIFESTS
        ],
        turns=repeats,
        measure=one_by_one(_opening),
    ),
)
