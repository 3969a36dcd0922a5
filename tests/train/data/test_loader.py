"""Laws of the data loader: batch i is the same scenes always, and errors arrive where they belong.

Laws of targets: block means are measurements, and bad values never reach the weights. Laws of the
order: each sample once an epoch, the same batches for any number of ranks; and the shards that are
open for it, whose memory does not grow with the dataset.
"""

import dataclasses
import itertools
import json
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.hits.tracing import with_traced
from storage.dataset.dataset import Dataset
from storage.dataset.shard import ShardReader, write_shard
from storage.dataset.shard_set import ShardSet
from storage.errors import TrilightError
from storage.records.exr import encode_channels
from storage.records.profiles import PROFILES, Profile
from storage.records.sample import Sample, decode_sample, encode_sample, sample_key, stored_sample
from storage.seeds import rng_for
from tests.command_line import run_program
from tests.for_each import case, for_each
from tests.model.kit import tensors_of, tiny_config
from tests.train.data.test_augment import EVERYTHING
from tests.train.kit import plain_run, take
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.augment import augment_scene
from train.data.buckets import MOST_WASTE, bucket_scenes
from train.data.loader import OpenShards, prefetch
from train.data.order import RankSlice, Visit, visits_from
from train.data.scenes import (
    TrainingScene,
    block_mean,
    require_few_triangles,
    scene_of_views,
    training_scene,
)
from train.settings import AugmentationSettings

SETTINGS = plain_run(
    seed=1,
    shuffle_shards=2,
    scenes_per_step=6,
    resolution=16,
    views_per_scene=1,
    augmentation=AugmentationSettings(mirror=True, channels=True, vertex_order=True),
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return write_toy_dataset(folder, train=14, validation=2, per_shard=3, resolution=16)


def identity(scene: TrainingScene) -> tuple[str | bytes, ...]:
    """Key and bytes: two visits of a scene may differ in nothing that a sum would tell."""
    tensors = {**tensors_of(scene.tensors), "target": scene.target_VRR3}
    named = sorted(tensors.items())
    return (scene.key, *(tensor.contiguous().numpy().tobytes() for _, tensor in named))


def identities(batches: list[list[TrainingScene]]) -> list[list[tuple[str | bytes, ...]]]:
    return [[identity(scene) for scene in batch] for batch in batches]


WHOLE = 8


@pytest.fixture(scope="module")
def whole(data: Dataset) -> list[list[TrainingScene]]:
    """Batches of more than three epochs, uninterrupted."""
    return take(data, SETTINGS, WHOLE)


@for_each("world_size", [2, 3, 6])
@for_each("first", range(0, WHOLE, 3))
def test_any_number_of_ranks_may_go_on(
    data: Dataset, whole: list[list[TrainingScene]], first: int, world_size: int
) -> None:
    part: dict[str, Any] = {"first": first, "world_size": world_size}
    shares = [
        take(data, SETTINGS, WHOLE - first, rank=rank, workers=1 + rank % 2, **part)
        for rank in range(world_size)
    ]
    assert {len(batch) for share in shares for batch in share} == {6 // world_size}
    together = [list(itertools.chain(*parts)) for parts in zip(*shares, strict=True)]
    for got, wanted in zip(identities(together), identities(whole[first:]), strict=True):
        assert sorted(got) == sorted(wanted)


def test_resuming_after_every_batch_and_any_number_of_threads_change_nothing(
    data: Dataset, whole: list[list[TrainingScene]]
) -> None:
    for first in range(WHOLE):
        resumed = take(data, SETTINGS, WHOLE - first, first=first)
        assert identities(resumed) == identities(whole[first:]), first
    for workers in (0, 2, 5):
        before = threading.active_count()
        with case(workers):
            assert identities(take(data, SETTINGS, WHOLE, workers=workers)) == identities(whole)
            assert threading.active_count() <= before, "closing the stream ends its threads"


def test_epochs_show_every_scene_and_differ(whole: list[list[TrainingScene]]) -> None:
    scenes = [scene for batch in whole for scene in batch]
    epochs = [scenes[start : start + 14] for start in (0, 14, 28)]
    keys = [[scene.key for scene in epoch] for epoch in epochs]
    assert all(len(set(epoch)) == 14 for epoch in keys)
    assert len({tuple(epoch) for epoch in keys}) == 3
    visits = [scene for scene in scenes if scene.key == keys[0][0]]
    assert identity(visits[0]) != identity(visits[1]), "each draws its views and symmetries"


def test_views_are_drawn_without_repetition_and_equal_shares(data: Dataset) -> None:
    with pytest.raises(TrilightError, match="not divisible by 4 ranks"):
        take(data, SETTINGS, 1, world_size=4)
    settings = plain_run(
        seed=0, shuffle_shards=1, scenes_per_step=7, resolution=8, views_per_scene=2
    )
    for scene in take(data, settings, 1)[0]:
        poses = scene.tensors.c2w_V44.numpy()
        assert poses.shape[0] == 2
        assert abs(poses[0] - poses[1]).max() > 0


def test_a_bug_in_the_thread_is_not_swallowed() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise RuntimeError("a bug")

    items = prefetch(broken(), 2)
    assert next(items) == 1
    with pytest.raises(RuntimeError, match="a bug"):
        next(items)


def test_albedo_is_that_of_the_scene_after_its_symmetries(data: Dataset) -> None:
    """Mirrored, turned and recoloured, as the network would ask for it itself."""
    augmentation = AugmentationSettings(rotation="uniform", mirror=True, channels=True)
    network = tiny_config(demodulated=True, hit_rays=2)
    settings = dataclasses.replace(SETTINGS, augmentation=augmentation, model=network)
    plain = dataclasses.replace(settings, model=tiny_config())
    pairs = zip(take(data, settings, 1)[0], take(data, plain, 1)[0], strict=True)
    for scene, other in pairs:
        expected = with_traced(other.tensors, 16, network).albedo_VRR6
        assert expected is not None and scene.tensors.albedo_VRR6 is not None
        assert torch.equal(scene.tensors.albedo_VRR6, expected) and expected.max() > 0
        assert identity(other) == identity(dataclasses.replace(scene, tensors=other.tensors))
        assert other.tensors.albedo_VRR6 is None


def test_a_smaller_picture_is_the_mean_of_its_blocks() -> None:
    pictures = rng_for(0, "pictures").uniform(0, 9, (2, 12, 12, 3)).astype(np.float32)
    small = block_mean(pictures, 4)
    assert small.shape == (2, 4, 4, 3) and small.dtype == np.float32
    for row in range(4):
        for column in range(4):
            block = pictures[:, 3 * row : 3 * row + 3, 3 * column : 3 * column + 3]
            # float32 mean of nine numbers below 9
            expected = block.mean(axis=(1, 2), dtype=np.float64)
            np.testing.assert_allclose(small[:, row, column], expected, rtol=1e-6)

    # halving twice is quartering, and light is kept
    pictures = rng_for(1, "pictures").uniform(0, 9, (1, 16, 16, 3)).astype(np.float32)
    twice = block_mean(block_mean(pictures, 8), 4)
    np.testing.assert_allclose(twice, block_mean(pictures, 4), rtol=1e-6)  # float32 means
    np.testing.assert_allclose(twice.mean(), pictures.mean(), rtol=1e-6)
    assert block_mean(pictures, 16) is pictures


@for_each("bad", [np.nan, np.inf, -np.inf, -1e-3])
def test_a_bad_target_is_refused_by_name(bad: float) -> None:
    sample = toy_sample(4, resolution=16)
    radiance = sample.radiance_rgb.copy()
    radiance[1, 2, 3, 0] = bad
    with pytest.raises(TrilightError, match=r"sample 000000004: view 1 .* at pixel \(2, 3\)"):
        dataclasses.replace(sample, radiance_rgb=radiance).check()
    lights = np.stack([sample.radiance_rgb, radiance], axis=1)
    with pytest.raises(TrilightError, match=r"view 1 light 1 has .* at pixel \(2, 3\)"):
        dataclasses.replace(sample, lights_rgb=lights).check()


def test_a_view_takes_its_target_and_noise_along_and_targets_are_logarithms(data: Dataset) -> None:
    sample = toy_sample(4, resolution=16)
    target = training_scene(sample, 16).target_VRR3.numpy()
    np.testing.assert_allclose(10.0**target - 1, sample.radiance_rgb, atol=1e-6)  # float32 log
    floors = (dataclasses.replace(sample.views[0], noise_floor_db=40.0), sample.views[1])
    scene = training_scene(dataclasses.replace(sample, views=floors), 16)
    torch.testing.assert_close(scene.noise_V, torch.tensor([1e-2, 1e-5]))
    most = sample.scene.num_triangles
    require_few_triangles(sample.key, sample.scene, most)
    with pytest.raises(TrilightError, match=f"{most} triangles; the run takes at most {most - 1}"):
        require_few_triangles(sample.key, sample.scene, most - 1)
    with pytest.raises(TrilightError, match="the run takes at most 1"):
        take(data, dataclasses.replace(SETTINGS, most_triangles=1), 1)
    with pytest.raises(TrilightError, match=r"not kept apart, which light_mix needs.*per_light"):
        training_scene(sample, 16, lights_apart=True)


def cost(num_triangles: int) -> float:
    """Mostly what the pictures cost, as in a small network."""
    return 300.0 + num_triangles


@for_each("most", [2, 16])
def test_buckets_hold_each_scene_once_and_waste_little(most: int) -> None:
    scenes = [training_scene(toy_sample(index), 8) for index in range(12)]
    batches = bucket_scenes(scenes, cost, most)
    lengths: list[int] = []
    for batch in batches:
        longest = batch.scenes.triangles_BT33.shape[1]
        mask = batch.scenes.is_triangle_BT
        own = mask.sum(1).tolist() if mask is not None else [longest] * len(batch.target_BVRR3)
        assert longest == max(own)
        assert len(own) * cost(longest) <= (1 + MOST_WASTE) * sum(cost(one) for one in own)
        assert len(batch.target_BVRR3) == len(batch.noise_BV) == len(own) <= most
        lengths += own
    assert sorted(lengths) == sorted(scene.tensors.num_triangles for scene in scenes)
    assert 1 < len(batches) < len(scenes)


@for_each("profile", PROFILES)
@for_each("lights_apart", [False, True])
def test_drawn_views_are_those_of_the_whole_sample_to_the_bit(
    profile: Profile, lights_apart: bool
) -> None:
    """Looked up by bits, or computed for each pixel; after all symmetries, at both resolutions."""
    sample = toy_sample(1, resolution=16, views=3)
    noisy = tuple(dataclasses.replace(view, noise_floor_db=20.0) for view in sample.views)
    sample = dataclasses.replace(sample, views=noisy)
    if lights_apart:
        exact = sample.radiance_rgb.astype(np.float16).astype(np.float32)
        sample = dataclasses.replace(sample, radiance_rgb=exact, lights_rgb=exact[:, None])
    members = encode_sample(sample, profile)
    whole, stored = decode_sample("1", members), stored_sample("1", members)
    light_mix = 2.0 if lights_apart else 1.0
    settings = dataclasses.replace(EVERYTHING, translation=0.0, light_mix=light_mix)
    for seed, resolution in enumerate((16, 16, 8, 16)):
        full = training_scene(whole, resolution, lights_apart=lights_apart)
        drawn = scene_of_views(stored, [0, 2], resolution, per_light=lights_apart)
        wanted = augment_scene(full, settings, np.random.default_rng(seed))
        got = augment_scene(drawn, settings, np.random.default_rng(seed))
        assert torch.equal(got.target_VRR3, wanted.target_VRR3[[0, 2]])
        assert torch.equal(got.noise_V, wanted.noise_V[[0, 2]])
        for name, tensor in tensors_of(wanted.tensors).items():
            wanted_tensor = tensor[[0, 2]] if name in ("c2w_V44", "fov_deg_V") else tensor
            assert torch.equal(getattr(got.tensors, name), wanted_tensor)


def test_what_is_no_half_float_is_no_row() -> None:
    """Zeros with a sign are zeros; a picture of another tool's float32 is computed as it is."""
    sample = toy_sample(1, resolution=8)
    radiance = sample.radiance_rgb.copy()
    radiance[0, 0, 0] = -0.0
    members = encode_sample(dataclasses.replace(sample, radiance_rgb=radiance))
    drawn = scene_of_views(stored_sample("1", members), [0], 8)
    assert drawn.target_VRR3[0, 0, 0].tolist() == [0.0, 0.0, 0.0]
    members["1.exr"] = encode_channels({"RGB": sample.radiance_rgb[1]})
    mixed = scene_of_views(stored_sample("1", members), [0, 1], 8)
    wanted = torch.from_numpy(np.log10(1 + sample.radiance_rgb[1]).astype(np.float32))
    assert torch.equal(mixed.target_VRR3[1], wanted)


SIZES = st.lists(st.integers(0, 9), min_size=1, max_size=9).filter(any)
WORLDS = (1, 2, 3, 8)
BATCH = 24


def places(
    sizes: list[int], first: int = 0, *, seed: int = 0, window: int = 2, count: int | None = None
) -> list[Visit]:
    """Return the visits from `first` on to the end of two epochs, or so many."""
    stream = visits_from(len(sizes), sizes.__getitem__, first, seed=seed, window=window)
    return list(itertools.islice(stream, 2 * sum(sizes) - first if count is None else count))


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.integers(1, 12), st.integers(0, 3))
def test_an_epoch_uses_every_sample_once_and_windows_of_shards_follow_each_other(
    sizes: list[int], window: int, seed: int
) -> None:
    found = places(sizes, seed=seed, window=window)
    every = {(shard, row) for shard, size in enumerate(sizes) for row in range(size)}
    total = len(every)
    assert [place.position for place in found] == list(range(2 * total))
    for epoch in (found[:total], found[total:]):
        assert {(place.shard, place.row) for place in epoch} == every
        numbers = [place.arrival // window for place in epoch]
        assert numbers == sorted(numbers), "one window of shards after the other"
        for _, shared in itertools.groupby(epoch, lambda place: place.arrival // window):
            visits = list(shared)
            held = {place.shard for place in visits}
            assert len(held) <= window and len(visits) == sum(sizes[shard] for shard in held)


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.data())
def test_entering_later_gives_the_rest(sizes: list[int], data: st.DataObject) -> None:
    first = data.draw(st.integers(0, 2 * sum(sizes) - 1))
    assert places(sizes, first) == places(sizes)[first:]


def test_the_order_is_a_function_of_seed_and_epoch() -> None:
    sizes = [16, 16, 16]
    assert places(sizes, seed=3) == places(sizes, seed=3)
    both = [places(sizes, seed=seed, window=3) for seed in range(3)]
    epochs = [epoch for found in both for epoch in (found[:48], found[48:])]
    assert len({tuple((p.shard, p.row) for p in epoch) for epoch in epochs}) == 6
    assert len({tuple(p.shard for p in epoch) for epoch in epochs}) == 6


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.integers(0, 40), st.integers(1, 5))
def test_the_ranks_share_out_every_batch(sizes: list[int], first: int, window: int) -> None:
    """Whatever their number: each place with one rank, equally many each, nobody left out."""
    stream = places(sizes, first, seed=1, window=window, count=3 * BATCH)
    for batch in (stream[at : at + BATCH] for at in range(0, 3 * BATCH, BATCH)):
        assert [place.position for place in batch] == list(range(first, first + BATCH))
        first += BATCH
        for world in WORLDS:
            shares = [RankSlice(rank=r, world_size=world).of_batch(batch) for r in range(world)]
            assert {len(share) for share in shares} == {BATCH // world}
            assert sorted(itertools.chain(*shares), key=lambda p: p.position) == batch


def test_each_rank_reads_few_shards_of_a_window() -> None:
    """That is why batches are shared out by shard: 2 ranks of 8 shards need about 4 each."""
    stream = places([64] * 8, window=8, count=8 * 64)
    read: list[set[int]] = [set(), set()]
    samples: list[list[int]] = [[], []]
    for batch in (stream[at : at + 64] for at in range(0, 8 * 64, 64)):
        for rank in range(2):
            mine = RankSlice(rank=rank, world_size=2).of_batch(batch)
            read[rank] |= {place.shard for place in mine}
            samples[rank] += [place.arrival for place in mine]
    # measured: 5 and 5 of 8; a share drawn without regard to shards needs all 8
    assert max(len(shards) for shards in read) <= 6
    assert max(samples[0]) < 6 and min(samples[1]) > 1


def test_ranks_that_do_not_exist_unequal_shares_and_empty_shards_are_refused() -> None:
    for rank, world_size in ((1, 1), (-1, 2), (0, 0)):
        with case(rank), pytest.raises(TrilightError, match="expected a rank from 0"):
            RankSlice(rank=rank, world_size=world_size)
    with pytest.raises(TrilightError, match="batch of 10 scenes is not divisible by 4 ranks"):
        RankSlice(rank=0, world_size=4).require_equal(10)
    with pytest.raises(TrilightError, match="all 3 shards are empty"):
        places([0, 0, 0], count=1)


class _Shard(ShardReader):
    def __init__(self, name: str, closed: list[str]) -> None:
        self.name = name
        self.closed = closed

    def close(self) -> None:
        self.closed.append(self.name)


class _Shards(ShardSet):
    names: Sequence[str] = ("a", "b", "c", "broken")

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.closed: list[str] = []

    def num_samples(self, number: int) -> int:
        return 1

    def open(self, number: int) -> ShardReader:
        if number == 3:
            raise TrilightError("broken: is broken")
        self.opened.append(self.names[number])
        return _Shard(self.names[number], self.closed)


def test_shards_are_open_from_their_first_sample_to_their_last_and_errors_come_to_who_reads() -> (
    None
):
    shards = _Shards()
    with OpenShards(shards) as opened:
        opened.plan([0, 0, 1])
        opened.plan([1, 2])
        assert [opened.read(number).name for number in (0, 1, 2)] == ["a", "b", "c"]
        opened.mark_read([0, 0, 1])
        assert shards.closed == ["a"]
        assert opened.read(1).name == "b"
        opened.mark_read([1])
        assert shards.closed == ["a", "b"]
        opened.plan([0])
        assert opened.read(0).name == "a"
        assert sorted(shards.opened) == ["a", "a", "b", "c"]
    assert sorted(shards.closed) == ["a", "a", "b", "c"]
    with OpenShards(_Shards()) as opened:
        opened.plan([3, 0])
        assert opened.read(0).name == "a"
        with pytest.raises(TrilightError, match="is broken"):
            opened.read(3)
        opened.mark_read([3])


SHARDS, PER_SHARD, NOISY_PX = 30, 8, 128

CHILD = """
import itertools, json, resource, sys
from storage.dataset.training_data import open_training_data
from tests.train.kit import plain_run, stream
settings = plain_run(seed=0, shuffle_shards=2, scenes_per_step=8, resolution=16, views_per_scene=2)
count = peak = 0
with stream(open_training_data([sys.argv[1]]), settings, workers=2) as batches:
    for batch in itertools.islice(batches, int(sys.argv[2])):
        count += len(batch)
        pages = int(open("/proc/self/statm").read().split()[1])
        peak = max(peak, pages * resource.getpagesize())
print(json.dumps([count, peak]))
"""


def noisy(index: int) -> Sample:
    """A sample whose pictures cannot be packed into less."""
    rng = np.random.default_rng(index)
    picture = rng.random((2, NOISY_PX, NOISY_PX, 3)).astype(np.float32)
    return dataclasses.replace(
        toy_sample(0, resolution=8), key=sample_key(index), radiance_rgb=picture
    )


def peak_bytes(folder: Path, num_shards: int) -> int:
    """Return the most memory of a process that reads so many shards once."""
    pattern = f"{folder}/train-{{000000..{num_shards - 1:06d}}}.tar"
    command = [sys.executable, "-c", CHILD, pattern, str(num_shards * PER_SHARD // 8)]
    count, peak = json.loads(run_program(command).stdout)
    assert count == num_shards * PER_SHARD
    return int(peak)


@pytest.mark.slow("memory")
def test_the_reader_holds_as_much_of_a_large_set_as_of_a_small_one(tmp_path: Path) -> None:
    """6 shards of 1.4 MB and 30: what is read grows by 33 MB, more when it is unpacked."""
    for number in range(SHARDS):
        samples = [noisy(PER_SHARD * number + row) for row in range(PER_SHARD)]
        path = tmp_path / f"train-{number:06d}.tar"
        write_shard(path, [(sample.key, encode_sample(sample)) for sample in samples])
    more = sum(path.stat().st_size for path in tmp_path.iterdir()) * (SHARDS - 6) // SHARDS
    grown = peak_bytes(tmp_path, SHARDS) - peak_bytes(tmp_path, 6)
    # a tenth of what was read leaves room for what the allocator keeps; measured: 0.5 MB
    assert grown < more / 10
