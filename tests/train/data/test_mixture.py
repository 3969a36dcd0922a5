"""Laws of a stream of several datasets: shares, each one's own order, and going on anywhere.

Damaged or malformed data: the first ends the run, or it is named, replaced and bounded.

The way to the network: how many threads decode, and what arrives on the device. The same batches
on every device, and on a card beside its kernels.
"""

import contextlib
import dataclasses
import itertools
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import safetensors.numpy
import torch
from torch import Tensor

from model.open import path_of_step
from storage.conventions import log10_radiance
from storage.dataset.dataset import Dataset
from storage.dataset.shard import ShardReader, write_shard
from storage.dataset.shard_set import ShardSet
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from tests.for_each import for_each
from tests.storage.dataset.test_verify import replace_shard
from tests.train.data.test_loader import identities
from tests.train.fake_card import CARD, fake_card
from tests.train.kit import (
    CPU,
    flip_a_bit,
    keys_of,
    plain_run,
    require_resumed_to_the_bit,
    stream,
    take,
    tiny_run,
    trained,
)
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.bad_samples import BadSampleCounter, first_samples
from train.data.buckets import CopyStream, StepScenes, step_scenes
from train.data.loader import MAX_THREADS, choose_workers
from train.data.order import RECORD, Mixture, plan_mixture
from train.data.scenes import TrainingScene, stored_levels
from train.loop.checkpoints import read_checkpoint
from train.settings import AugmentationSettings

BATCH = 4
SETTINGS = plain_run(
    seed=1, shuffle_shards=2, scenes_per_step=BATCH, resolution=16, views_per_scene=1
)


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two datasets; the second is smaller, of larger pictures, and has other views."""
    first, second = (tmp_path_factory.mktemp(name) for name in ("first", "second"))
    write_toy_dataset(first, train=7, validation=2, per_shard=2, resolution=16)
    write_toy_dataset(second, train=3, validation=1, per_shard=2, resolution=32)
    return [str(first), str(second)]


@pytest.fixture(scope="module")
def data(roots: list[str]) -> TrainingData:
    return open_training_data(roots, may_mix=True)


def mixture(*weights: float) -> Mixture:
    return Mixture(
        digests=tuple(f"{row}" for row in range(len(weights))),
        names=tuple("abc"[: len(weights)]),
        weights=weights,
        before=(0,) * len(weights),
        scenes_per_step=BATCH,
    )


@for_each("weights", [(1.0,), (3.0, 1.0), (0.1, 0.2, 0.7), (1e-3, 5.0), (7.0, 3e5)])
def test_every_stretch_has_its_shares_and_may_be_entered_anywhere(
    weights: tuple[float, ...],
) -> None:
    mixed = mixture(*weights)
    turns = list(itertools.islice(mixed.order_from(0)[1], 3000))
    for at in (0, 1, 17, 999, 2990):
        counts = tuple(turns[:at].count(source) for source in range(len(weights)))
        assert mixed.order_from(at)[0] == counts
        assert list(itertools.islice(mixed.order_from(at)[1], 10)) == turns[at : at + 10]
        for source, weight in enumerate(weights):
            assert abs(counts[source] - at * weight / sum(weights)) < len(weights)
    far = 10**15
    assert sum(mixed.order_from(far)[0]) == far, "in the time of the first"


WEIGHTS = (2.0, 1.0)
WHOLE = 9
"""Batches: four times the smaller dataset."""


@pytest.fixture(scope="module")
def whole(data: TrainingData) -> list[list[TrainingScene]]:
    return take(data, SETTINGS, WHOLE, mixture=mixture(*WEIGHTS))


def test_each_dataset_keeps_the_order_that_it_has_alone(
    roots: list[str], whole: list[list[TrainingScene]]
) -> None:
    scenes = [scene for batch in whole for scene in batch]
    turns = list(itertools.islice(mixture(*WEIGHTS).order_from(0)[1], len(scenes)))
    assert [turns.count(source) for source in (0, 1)] == [24, 12]
    for source, root in enumerate(roots):
        alone = list(
            itertools.chain(*keys_of(take(open_training_data([root], may_mix=True), SETTINGS, 6)))
        )
        mine = [scene.key for scene, turn in zip(scenes, turns, strict=True) if turn == source]
        assert mine == alone[: len(mine)]
    smaller = [scene for scene, turn in zip(scenes, turns, strict=True) if turn == 1]
    assert len({scene.key for scene in smaller}) == 3
    again = [scene.target_VRR3 for scene in smaller if scene.key == smaller[0].key]
    assert any(not torch.equal(again[0], other) for other in again[1:]), "it draws views anew"


@for_each("first", range(1, WHOLE, 2))
def test_it_goes_on_anywhere_with_any_ranks_and_threads(
    data: TrainingData, whole: list[list[TrainingScene]], first: int
) -> None:
    part: dict[str, Any] = {"first": first, "mixture": mixture(*WEIGHTS)}
    count = WHOLE - first
    assert identities(take(data, SETTINGS, count, workers=3, **part)) == identities(whole[first:])
    shares = [take(data, SETTINGS, count, rank=rank, world_size=2, **part) for rank in (0, 1)]
    together = [list(itertools.chain(*parts)) for parts in zip(*shares, strict=True)]
    for got, wanted in zip(identities(together), identities(whole[first:]), strict=True):
        assert sorted(got) == sorted(wanted)


def test_a_dataset_that_is_known_goes_on_where_it_was(roots: list[str], data: TrainingData) -> None:
    """One alone, then two, then other weights, then the second alone."""
    run = tiny_run(scenes_per_step=BATCH)
    alone = [open_training_data([root], may_mix=True) for root in roots]
    header = {"step": 0, "settings": {"scenes_per_step": BATCH}, "data_digest": alone[0].digest}
    assert plan_mixture(alone[0], run, None) is None
    assert plan_mixture(alone[0], run, header | {"step": 5}) is None
    two = plan_mixture(data, run, header | {"step": 5})
    assert two is not None and two.weights == (7.0, 3.0), "shares as their numbers of scenes"
    assert (two.first, two.before) == (20, (20, 0))
    later = header | {"step": 10, RECORD: dataclasses.asdict(two), "data_digest": data.digest}
    assert plan_mixture(data, run, later) == two
    weighed = dataclasses.replace(run, data_weights=(1, 1))
    other = plan_mixture(data, weighed, later)
    assert other is not None and (other.first, other.before) == (40, (34, 6))
    wider = plan_mixture(data, tiny_run(scenes_per_step=2 * BATCH), later)
    assert wider is not None and (wider.first, wider.before) == (80, (34, 6))
    second = plan_mixture(alone[1], run, later)
    assert second is not None and second.before == (6,) and second.order_from(44)[0] == (10,)


def test_first_samples_come_from_every_dataset_and_mistakes_are_named(
    roots: list[str], data: TrainingData
) -> None:
    first = first_samples(data.split("train"), 5, BadSampleCounter(0))
    assert [sample.radiance_rgb.shape[1] for sample in first] == [16, 16, 16, 32, 32]
    assert len(list(first_samples(data.split("validation"), 99, BadSampleCounter(0)))) == 3
    with pytest.raises(TrilightError, match="holds the same dataset as .*data_weights says"):
        open_training_data([roots[0], roots[1], roots[0]], may_mix=True)
    with pytest.raises(TrilightError, match="2 places of which 1 are shards"):
        open_training_data([roots[0], f"{roots[1]}/train-000000.tar"], may_mix=True)
    with pytest.raises(TrilightError, match="3 numbers, but --data names 2 datasets"):
        plan_mixture(data, tiny_run(data_weights=(1.0, 1.0, 1.0)), None)
    with pytest.raises(TrilightError, match="data_weights"):
        tiny_run(data_weights=(1.0, 0.0))


def test_a_damaged_shard_is_replaced_by_its_own_datasets(tmp_path: Path) -> None:
    for name, resolution in (("a", 16), ("b", 32)):
        (tmp_path / name).mkdir()
        write_toy_dataset(
            tmp_path / name, train=4, validation=1, per_shard=2, resolution=resolution
        )
    (tmp_path / "a" / "train-000001.tar").write_bytes(b"no shard")
    mixed, unusable = (
        open_training_data([str(tmp_path / "a"), str(tmp_path / "b")], may_mix=True),
        BadSampleCounter(2),
    )
    turns = list(itertools.islice(mixture(1.0, 1.0).order_from(0)[1], 16))
    found = take(mixed, SETTINGS, 4, workers=2, unusable=unusable, mixture=mixture(1.0, 1.0))
    keys = itertools.chain(*keys_of(found))
    (message,) = unusable.messages
    assert "train-000001.tar" in message
    of_first = {key for key, turn in zip(keys, turns, strict=True) if turn == 0}
    assert of_first == {"000000000", "000000001"}


def test_a_run_of_two_datasets_resumes_to_the_bit_and_takes_up_a_third(
    roots: list[str], tmp_path: Path
) -> None:
    settings = tiny_run(data_weights=(1.0, 2.0), num_steps=8, validation_scenes=2)
    out = tmp_path / "resumed"
    require_resumed_to_the_bit(settings, roots, out, workers=3)
    header = read_checkpoint(path_of_step(out / "checkpoints", 8)).header
    assert header["data_digest"].startswith("mix:") and len(header[RECORD]["digests"]) == 2
    (tmp_path / "third").mkdir()
    write_toy_dataset(tmp_path / "third", train=2, validation=1, per_shard=2, resolution=16)
    three = [*roots, str(tmp_path / "third")]
    digest = open_training_data(three, may_mix=True).digest
    with pytest.raises(TrilightError, match=r"--change data=mix:[0-9a-f]{12}"):
        trained(settings, three, out, resume=True)
    decided = {"data": digest[:16], "data_weights": (1.0, 2.0, 1.0), "num_steps": 10}
    trained(settings, three, out, resume=True, decisions=decided)
    header = read_checkpoint(path_of_step(out / "checkpoints", 10)).header
    assert header[RECORD]["first"] == 24 and header[RECORD]["before"] == [8, 16, 0]


GIB = 1 << 30
FREE = "MemFree: 1 kB\nMemAvailable: {} kB\n"


@for_each(
    ("files", "processes", "on_card", "threads", "said"),
    [
        ({}, 1, True, MAX_THREADS, "8 threads decode samples, by 16 cores"),
        ({}, 8, False, 1, "1 thread decodes samples, by 16 cores for 8 processes"),
        ({"proc/meminfo": FREE.format(65536)}, 1, True, 5, "16 cores and 0.1 GiB of free memory"),
        ({"sys/fs/cgroup/cpu.max": "350000 100000\n"}, 1, False, 2, "by 3.5 cores"),
        (
            {
                "proc/self/cgroup": "0::/job/step\n",
                "sys/fs/cgroup/job/cpu.max": "400000 100000",
                "sys/fs/cgroup/job/step/cpu.max": "max 100000",
                "sys/fs/cgroup/job/memory.max": f"{8 * GIB}",
                "sys/fs/cgroup/job/memory.current": f"{8 * GIB - (1 << 26)}",
                "proc/meminfo": FREE.format(104857600),
            },
            2, True, 1, "by 4 cores for 2 processes",
        ),
        (
            {
                "proc/self/cgroup": "4:memory:/x\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "200000",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712",
                "sys/fs/cgroup/memory/memory.usage_in_bytes": "1000",
            },
            1, True, 1, "by 2 cores",
        ),
    ],
)  # fmt: skip
def test_threads_are_what_a_machine_spares_as_its_files_say(
    files: dict[str, str],
    processes: int,
    on_card: bool,
    threads: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes))
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    run = dataclasses.replace(tiny_run(resolution=256), views_per_scene=2)
    found, reason = choose_workers(run, on_gpu=on_card, busy_threads=1, root=tmp_path)
    assert found == threads and reason.endswith(said), reason


LIT = AugmentationSettings(mirror=True, channels=True, light_scale=3.0)
LIT_SETTINGS = plain_run(
    seed=2, shuffle_shards=2, scenes_per_step=6, resolution=16, views_per_scene=2, augmentation=LIT
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return write_toy_dataset(folder, train=6, validation=1, per_shard=3, resolution=16)


@contextlib.contextmanager
def steps(dataset: Dataset, device: torch.device = CPU) -> Iterator[Iterator[StepScenes]]:
    with (
        stream(dataset, LIT_SETTINGS, workers=2) as batches,
        closing(step_scenes(batches, float, 3, device)) as found,
    ):
        yield found


def test_batches_are_made_ahead_and_closing_ends_the_thread(dataset: Dataset) -> None:
    before = threading.active_count()
    with steps(dataset) as found:
        step = next(found)
        assert sorted(step.keys) == [f"00000000{row}" for row in range(6)]
        assert sum(len(batch.noise_BV) for batch in step.batches) == 6
        assert [len(batch.noise_BV) for batch in step.batches] == [3, 3] or len(step.batches) > 2
        assert CopyStream(CPU).send(step.batches) == step.batches
    assert threading.active_count() == before


def logged(patch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """Return what a card is asked to do from now on, in order."""
    said: list[tuple[str, Any]] = []
    pinned: list[Tensor] = []

    class Stream:
        def __init__(self, device: torch.device | None = None) -> None:
            self.numbers = itertools.count(1)

        def record_event(self) -> Any:
            said.append(("event", next(self.numbers)))
            return said[-1][1]

        def wait_event(self, event: int) -> None:
            said.append(("wait", event))

    def pin(tensor: Tensor) -> Tensor:
        pinned.append(tensor.clone())
        return pinned[-1]

    plain = Tensor.to

    def to(tensor: Tensor, device: torch.device, *, non_blocking: bool = False) -> Tensor:
        is_pinned = any(tensor is each for each in pinned)
        said.append(("copy" if is_pinned and non_blocking else "slow copy", None))
        return plain(tensor, device)

    def record_stream(tensor: Tensor, stream: Stream) -> None:
        said.append(("kept", tensor.device.type))

    patch.setattr(torch.backends.cuda, "is_built", lambda: True)
    patch.setattr(torch.cuda, "Stream", Stream)
    patch.setattr(torch.cuda, "stream", lambda _: contextlib.nullcontext())
    patch.setattr(torch.cuda, "current_stream", lambda _: Stream())
    for function in (to, record_stream):
        patch.setattr(Tensor, function.__name__, function)
    patch.setattr(Tensor, "pin_memory", pin)
    return said


def test_a_card_gets_copies_beside_its_kernels(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From pinned memory, all queued at once, each waited for alone, kept until it is used."""
    said = logged(monkeypatch)
    with steps(dataset, CARD) as found:
        step = next(found)
    with fake_card():
        sent = CopyStream(CARD).send(step.batches)
        assert len(sent) > 1
        queued = said.copy()
        said.clear()
        arrived = [batch.to(CARD) for batch in sent]
    kinds = [kind for kind, _ in queued]
    assert "slow copy" not in kinds and "wait" not in kinds
    assert [number for kind, number in queued if kind == "event"] == [*range(1, len(sent) + 1)]
    assert [number for kind, number in said if kind == "wait"] == [*range(1, len(sent) + 1)]
    assert {kind for kind, _ in said} == {"wait", "kept"}, "nothing is copied twice"
    assert said.count(("kept", "cuda")) == kinds.count("copy")
    for batch in arrived:
        assert batch.target_BVRR3.device == CARD and batch.target_BVRR3.dtype == torch.float32


def test_rows_of_targets_are_the_logarithms_of_all_half_floats() -> None:
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    assert np.array_equal(stored_levels(), log10_radiance(halves).astype(np.float32))


EIGHT_RUN = dataclasses.replace(SETTINGS, seed=0, resolution=8)
BAD_KEY = "000000002"


def keys(
    data: TrainingData | Dataset, unusable: BadSampleCounter, *, count: int = 4, **ranks: Any
) -> list[list[str]]:
    return keys_of(take(data, EIGHT_RUN, count, workers=2, unusable=unusable, **ranks))


@pytest.fixture
def eight(tmp_path: Path) -> Dataset:
    return write_toy_dataset(tmp_path, train=8, validation=1, per_shard=2, resolution=8)


def spoil_sample(eight: Dataset, suffixes: tuple[str, ...] = ("0.exr", "1.exr")) -> None:
    """Make pictures of a sample unreadable whose shard has the hash of the manifest."""
    samples = [
        (sample.key, encode_sample(sample))
        for sample in (toy_sample(i, resolution=8) for i in (2, 3))
    ]
    samples[0][1].update(dict.fromkeys(suffixes, b"no picture"))
    replace_shard(eight, "train-000001.tar", samples)


def test_the_first_damage_ends_the_run_or_the_next_of_its_shard_replaces_it(
    eight: Dataset,
) -> None:
    """Whatever the ranks."""
    whole = keys(eight, BadSampleCounter(0))
    spoil_sample(eight)
    with pytest.raises(TrilightError, match=rf"train-000001\.tar: sample {BAD_KEY}: .*OpenEXR"):
        keys(eight, BadSampleCounter(0))
    unusable = BadSampleCounter(1)
    found = keys(eight, unusable)
    assert found == [[key.replace(BAD_KEY, "000000003") for key in batch] for batch in whole]
    assert len(unusable.messages) == 1 and BAD_KEY in unusable.messages[0]
    shares = [keys(eight, BadSampleCounter(1), rank=r, world_size=2) for r in range(2)]
    for batch, first, second in zip(found, *shares, strict=True):
        assert sorted(batch) == sorted([*first, *second])


def test_damage_costs_only_the_visits_that_draw_its_view(eight: Dataset) -> None:
    whole = keys(eight, BadSampleCounter(0))
    visits = [(batch, row) for batch in range(4) for row in range(4)]
    replaced = list[set[tuple[int, int]]]()
    for suffix in ("0.exr", "1.exr"):
        spoil_sample(eight, (suffix,))
        found = keys(eight, BadSampleCounter(1))
        replaced.append({at for at in visits if found[at[0]][at[1]] != whole[at[0]][at[1]]})
    drawn = {at for at in visits if whole[at[0]][at[1]] == BAD_KEY}
    assert replaced[0] | replaced[1] == drawn and not replaced[0] & replaced[1]


def test_a_shard_is_replaced_and_counts_with_its_samples(eight: Dataset) -> None:
    whole = keys(eight, BadSampleCounter(0))
    flip_a_bit(eight.folder.shard("train-000001.tar"))
    unusable = BadSampleCounter(2)
    found = keys(eight, unusable)
    assert [len(batch) for batch in found] == [4, 4, 4, 4]
    kept = [k for batch in whole for k in batch]
    for before, after in zip(kept, itertools.chain(*found), strict=True):
        lost = before in ("000000002", "000000003")
        assert after not in ("000000002", "000000003")
        assert lost or after == before
    assert "train-000001.tar" in unusable.messages[0] and "sha256" in unusable.messages[0]
    with pytest.raises(TrilightError, match="2 samples are unusable; expected at most 1"):
        keys(eight, BadSampleCounter(1))


def test_a_list_with_an_unreadable_shard_goes_on_without_it(eight: Dataset) -> None:
    (eight.folder.root / "train-000001.tar").write_bytes(b"no shard at all")
    data = open_training_data([f"{eight.folder.root}/train-{{000000..000003}}.tar"])
    unusable = BadSampleCounter(1)
    found = keys(data, unusable, count=3)
    assert {key for batch in found for key in batch} == {
        f"00000000{index}" for index in (0, 1, 4, 5, 6, 7)
    }
    assert len(unusable.messages) == 1


def test_a_shard_that_ends_the_run_was_fetched_once_and_all_unusable_end_it(
    eight: Dataset,
) -> None:
    for path in eight.folder.root.glob("train-*.tar"):
        path.write_bytes(b"no shard at all")
    data = open_training_data([f"{eight.folder.root}/train-000000.tar"])
    fetch = mock.patch.object(ShardSet, "open", autospec=True, side_effect=ShardSet.open)
    with fetch as fetched, pytest.raises(TrilightError, match="train-000000"):
        keys(data, BadSampleCounter(0))
    assert fetched.call_count == 1
    with pytest.raises(
        TrilightError, match="no sample of 4 shards is usable. The last that was tried: "
    ):
        keys(eight, BadSampleCounter(10**9))


BOTH_VIEWS = dataclasses.replace(EIGHT_RUN, scenes_per_step=2, views_per_scene=2)
BAD, GOOD = "bad-000000.tar", "good-000000.tar"
Members = dict[str, bytes]


def lose_a_place(members: Members) -> None:
    """Put what is no number into the positions of a sample."""
    stored = safetensors.numpy.load(members["scene.safetensors"])
    arrays = {key: values.copy() for key, values in stored.items()}
    arrays["vertex_positions"][0, 1] = np.nan
    members["scene.safetensors"] = safetensors.numpy.save(arrays)


def write_shards(folder: Path, bad_samples: int) -> list[str]:
    """Write a shard whose first samples are spoilt and one without fault; return their paths."""
    for name, first, count in ((BAD, 0, 3), (GOOD, 3, 2)):
        samples = []
        for index in range(first, first + count):
            sample = toy_sample(index, resolution=8, views=2)
            members = encode_sample(sample)
            if index < bad_samples:
                lose_a_place(members)
            samples.append((sample.key, members))
        write_shard(folder / name, samples)
    return [f"{folder}/{BAD}", f"{folder}/{GOOD}"]


def spoilt_keys(paths: list[str], unusable: BadSampleCounter, count: int = 5) -> set[str]:
    found = take(open_training_data(paths), BOTH_VIEWS, count, unusable=unusable)
    return set(itertools.chain(*keys_of(found)))


def test_a_shard_that_is_all_bad_is_given_up_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = write_shards(tmp_path, bad_samples=3)
    decode = ShardReader.stored_sample
    read: Any = mock.create_autospec(decode, side_effect=decode)
    monkeypatch.setattr(ShardReader, "stored_sample", read)
    unusable = BadSampleCounter(3)
    found = spoilt_keys(paths, unusable, count=10)
    assert found == {"000000003", "000000004"}
    assert len(unusable.messages) == 3
    for row, message in enumerate(unusable.messages):
        assert message.isprintable() and f"/{BAD}: sample 00000000{row}: " in message
        assert "vertex_positions[0, 1] is nan" in message
    bad = [each.args[1] for each in read.call_args_list if BAD in each.args[0].name]
    assert len(bad) == len(set(bad)) == 3


def test_a_scene_with_fewer_views_than_are_drawn_is_replaced(tmp_path: Path) -> None:
    paths = write_shards(tmp_path, bad_samples=0)
    (tmp_path / GOOD).unlink()
    few = toy_sample(3, resolution=8, views=1)
    write_shard(tmp_path / GOOD, [(few.key, encode_sample(few))])
    unusable = BadSampleCounter(1)
    assert few.key not in spoilt_keys(paths, unusable)
    assert "1 views; the run draws 2 of each scene" in unusable.messages[0]
