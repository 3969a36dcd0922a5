"""The way to the network: how many threads decode, and what arrives on the device.

The same batches on every device, and on a card beside its kernels.
"""

import contextlib
import dataclasses
import itertools
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from storage.conventions import log10_radiance
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import open_training_data
from tests.for_each import for_each
from tests.train.fake_card import CARD, fake_card
from tests.train.kit import CPU, tiny_run
from tests.train.toy import write_toy_dataset
from train.data.bad_samples import BadSampleCounter
from train.data.device_prefetch import CopyStream, StepScenes, decodes_on_device, step_scenes
from train.data.order import RankSlice
from train.data.scenes import stored_levels
from train.data.stream import StreamSettings, stream_batches
from train.data.workers import MAX_THREADS, Machine, choose_workers, detect_machine
from train.settings import AugmentationSettings

GIB = 1 << 30


def system(root: Path, files: dict[str, str]) -> Path:
    """Write files of a system into a folder; returns it."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


@for_each(
    ("files", "cores", "free"),
    [
        ({}, 16.0, None),
        ({"proc/meminfo": "MemFree: 1 kB\nMemAvailable: 2097152 kB\n"}, 16.0, 2 * GIB),
        ({"sys/fs/cgroup/cpu.max": "350000 100000\n"}, 3.5, None),
        (
            {
                "proc/self/cgroup": "0::/job/step\n",
                "sys/fs/cgroup/job/cpu.max": "400000 100000",
                "sys/fs/cgroup/job/step/cpu.max": "max 100000",
                "sys/fs/cgroup/job/memory.max": f"{8 * GIB}",
                "sys/fs/cgroup/job/memory.current": f"{5 * GIB}",
                "proc/meminfo": "MemAvailable: 104857600 kB\n",
            },
            4.0,
            3 * GIB,
        ),
        (
            {
                "proc/self/cgroup": "4:memory:/x\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "200000",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712",
                "sys/fs/cgroup/memory/memory.usage_in_bytes": "1000",
            },
            2.0,
            None,
        ),
    ],
)
def test_a_machine_is_what_its_files_say(
    files: dict[str, str],
    cores: float,
    free: int | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    found = detect_machine(system(tmp_path, files))
    assert found == Machine(cores=cores, free_bytes=free, processes=2)


@for_each(
    ("machine", "on_card", "threads", "said"),
    [
        (Machine(cores=2), False, 1, "1 thread decodes samples, by 2 cores"),
        (Machine(cores=8), True, 7, "7 threads decode samples, by 8 cores"),
        (Machine(cores=208, processes=8), True, MAX_THREADS, "by 208 cores for 8 processes"),
        (Machine(cores=64, free_bytes=GIB // 16), True, 5, "64 cores and 0.1 GiB of free memory"),
    ],
)
def test_threads_are_what_is_spare(
    machine: Machine, on_card: bool, threads: int, said: str
) -> None:
    run = dataclasses.replace(tiny_run(resolution=256), views_per_scene=2)
    found = choose_workers(machine, run, on_gpu=on_card, busy_threads=1)
    assert found.threads == threads and said in found.reason


LIT = AugmentationSettings(mirror=True, channels=True, light_scale=3.0)
SETTINGS = StreamSettings(
    seed=2, window=2, batch_size=6, resolution=16, views_per_scene=2, augmentation=LIT
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return write_toy_dataset(folder, train=6, validation=1, per_shard=3, resolution=16)


@contextlib.contextmanager
def steps(
    dataset: Dataset, device: torch.device = CPU, **changes: Any
) -> Iterator[Iterator[StepScenes]]:
    settings = dataclasses.replace(SETTINGS, **changes)
    batches = stream_batches(
        open_training_data([str(dataset.folder.root)]).split("train"),
        settings,
        0,
        rank_slice=RankSlice(),
        workers=2,
        unusable=BadSampleCounter(0),
    )
    with closing(batches), closing(step_scenes(batches, float, 3, device)) as found:
        yield found


@for_each("augmentation", [None, LIT])
def test_targets_that_are_looked_up_on_arrival_are_the_same_bits(
    dataset: Dataset, augmentation: AugmentationSettings | None
) -> None:
    """One table of all scenes, or one of each whose light was scaled."""
    pairs = []
    for looked_up in (True, False):
        with steps(dataset, lookup_in_threads=looked_up, augmentation=augmentation) as found:
            taken = list(itertools.islice(found, 2))
            pairs.append([batch for step in taken for batch in step.batches])
    for ready, rows in zip(*pairs, strict=True):
        assert ready.levels_BL is None and rows.levels_BL is not None
        assert rows.target_BVRR3.dtype == torch.int16, "half of the bytes on the way"
        assert len(rows.levels_BL) == (1 if augmentation is None else len(rows.noise_BV))
        there = rows.to(CPU)
        assert there.levels_BL is None and torch.equal(there.target_BVRR3, ready.target_BVRR3)


def test_batches_are_made_ahead_and_closing_ends_the_thread(dataset: Dataset) -> None:
    before = threading.active_count()
    with steps(dataset) as found:
        step = next(found)
        assert sorted(step.keys) == [f"00000000{row}" for row in range(6)]
        assert sum(len(batch.noise_BV) for batch in step.batches) == 6
        assert [len(batch.noise_BV) for batch in step.batches] == [3, 3] or len(step.batches) > 2
        assert CopyStream(CPU).send(step.batches) == step.batches
    assert threading.active_count() == before


class _Log:
    """What a card is asked to do, in order."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.said: list[tuple[str, Any]] = []
        self.pinned: list[Tensor] = []
        log = self

        class Stream:
            def __init__(self, device: torch.device | None = None) -> None:
                self.number = 0

            def record_event(self) -> int:
                self.number += 1
                log.said.append(("event", self.number))
                return self.number

            def wait_event(self, event: int) -> None:
                log.said.append(("wait", event))

        def pin(tensor: Tensor) -> Tensor:
            found = tensor.clone()
            log.pinned.append(found)
            return found

        plain = Tensor.to

        def to(tensor: Tensor, device: torch.device, *, non_blocking: bool = False) -> Tensor:
            is_pinned = any(tensor is each for each in log.pinned)
            log.said.append(("copy" if is_pinned and non_blocking else "slow copy", None))
            return plain(tensor, device)

        patch.setattr(torch.backends.cuda, "is_built", lambda: True)
        patch.setattr(torch.cuda, "Stream", Stream)
        patch.setattr(torch.cuda, "stream", lambda _: contextlib.nullcontext())
        patch.setattr(torch.cuda, "current_stream", lambda _: Stream())
        patch.setattr(Tensor, "pin_memory", pin)
        patch.setattr(Tensor, "to", to)
        patch.setattr(
            Tensor, "record_stream", lambda tensor, _: log.said.append(("kept", tensor.device.type))
        )


def test_a_card_gets_copies_beside_its_kernels(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From pinned memory, all queued at once, each waited for alone, kept until it is used."""
    assert decodes_on_device(CARD)
    log = _Log(monkeypatch)
    with steps(dataset, CARD, lookup_in_threads=False) as found:
        step = next(found)
    with fake_card():
        sent = CopyStream(CARD).send(step.batches)
        assert len(sent) > 1
        queued, log.said = log.said, []
        arrived = [batch.to(CARD) for batch in sent]
    kinds = [kind for kind, _ in queued]
    assert "slow copy" not in kinds and "wait" not in kinds
    assert [number for kind, number in queued if kind == "event"] == [*range(1, len(sent) + 1)]
    assert [number for kind, number in log.said if kind == "wait"] == [*range(1, len(sent) + 1)]
    assert {kind for kind, _ in log.said} == {"wait", "kept"}, "nothing is copied twice"
    assert log.said.count(("kept", "cuda")) == kinds.count("copy")
    for batch in arrived:
        assert batch.target_BVRR3.device == CARD and batch.target_BVRR3.dtype == torch.float32


def test_rows_of_targets_cover_all_pictures_but_those_of_another_resolution(tmp_path: Path) -> None:
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    assert np.array_equal(stored_levels().numpy(), log10_radiance(halves).astype(np.float32))
    data = write_toy_dataset(tmp_path, train=6, validation=1, per_shard=3, resolution=32)
    with steps(data, lookup_in_threads=False) as found:
        assert all(batch.levels_BL is None for batch in next(found).batches)
