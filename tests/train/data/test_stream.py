"""Laws of the stream: batch i is the same scenes for ever, and errors arrive where they belong.

Laws of targets: block means are measurements, and bad values never reach the weights.
"""

import dataclasses
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from model.demodulated import with_albedo
from model.scene_tensors import tensors_of
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.records.exr import encode_channels
from storage.records.profiles import PROFILES, Profile
from storage.records.sample import decode_sample, encode_sample
from storage.records.stored_sample import stored_sample
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.model.kit import tiny_config
from tests.train.kit import take
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.augment import augment_scene
from train.data.buckets import MOST_WASTE, bucket_scenes
from train.data.resolution import block_mean
from train.data.scenes import TrainingScene, scene_of_views, training_scene, with_target
from train.data.stream import StreamSettings, prefetch
from train.settings import AugmentationSettings

SETTINGS = StreamSettings(
    seed=1,
    window=2,
    batch_size=6,
    resolution=16,
    views_per_scene=1,
    augmentation=AugmentationSettings(mirror=True, channels=True, vertex_order=True),
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy")
    return write_toy_dataset(folder, train=14, validation=2, per_shard=3, resolution=16)


def same(a: TrainingScene, b: TrainingScene) -> bool:
    return (
        a.key == b.key
        and torch.equal(a.target_VRR3, b.target_VRR3)
        and all(
            torch.equal(value, getattr(b.tensors, name))
            for name, value in tensors_of(a.tensors).items()
        )
    )


def same_batches(a: list[list[TrainingScene]], b: list[list[TrainingScene]]) -> bool:
    return len(a) == len(b) and all(
        len(x) == len(y) and all(same(p, q) for p, q in zip(x, y, strict=True))
        for x, y in zip(a, b, strict=True)
    )


def by_key(batch: list[TrainingScene]) -> list[TrainingScene]:
    return sorted(batch, key=identity)


def identity(scene: TrainingScene) -> tuple[str | bytes, ...]:
    """Key and bytes: two visits of a scene may differ in nothing that a sum would tell."""
    tensors = [
        scene.target_VRR3,
        *(value for _, value in sorted(tensors_of(scene.tensors).items())),
    ]
    return (scene.key, *(tensor.contiguous().numpy().tobytes() for tensor in tensors))


WHOLE = 8


@pytest.fixture(scope="module")
def whole(data: Dataset) -> list[list[TrainingScene]]:
    """Batches of more than three epochs, uninterrupted."""
    return take(data, SETTINGS, WHOLE)


@for_each("first", range(WHOLE))
def test_resuming_after_every_batch_is_uninterrupted(
    data: Dataset, whole: list[list[TrainingScene]], first: int
) -> None:
    assert same_batches(whole[first:], take(data, SETTINGS, WHOLE - first, first=first))


@for_each("world_size", [2, 3, 6])
@for_each("first", range(0, WHOLE, 3))
def test_any_number_of_ranks_may_go_on(
    data: Dataset, whole: list[list[TrainingScene]], first: int, world_size: int
) -> None:
    shares = [
        take(
            data,
            SETTINGS,
            WHOLE - first,
            first=first,
            rank=rank,
            world_size=world_size,
            workers=1 + rank % 2,
        )
        for rank in range(world_size)
    ]
    assert {len(batch) for share in shares for batch in share} == {6 // world_size}
    together = [
        [scene for share in parts for scene in share] for parts in zip(*shares, strict=True)
    ]
    assert same_batches(
        [by_key(batch) for batch in together], [by_key(batch) for batch in whole[first:]]
    )


@for_each("workers", [0, 2, 5])
def test_the_number_of_threads_changes_nothing(
    data: Dataset, whole: list[list[TrainingScene]], workers: int
) -> None:
    before = threading.active_count()
    assert same_batches(take(data, SETTINGS, WHOLE, workers=workers), whole)
    assert threading.active_count() <= before, "closing the stream ends its threads"


def test_a_list_of_the_same_shards_gives_the_same_batches(
    data: Dataset, whole: list[list[TrainingScene]]
) -> None:
    listed = open_training_data([f"{data.folder.root}/train-{{000000..000004}}.tar"])
    assert "without a manifest" in listed.notes[0]
    assert same_batches(take(listed, SETTINGS, 4), whole[:4])
    assert same_batches(take(listed, SETTINGS, 2, first=3), whole[3:5])


def test_epochs_show_every_scene_and_differ(whole: list[list[TrainingScene]]) -> None:
    scenes = [scene for batch in whole for scene in batch]
    epochs = [scenes[start : start + 14] for start in (0, 14, 28)]
    keys = [[scene.key for scene in epoch] for epoch in epochs]
    assert all(len(set(epoch)) == 14 for epoch in keys)
    assert len({tuple(epoch) for epoch in keys}) == 3
    visits = [scene for scene in scenes if scene.key == keys[0][0]]
    assert not same(visits[0], visits[1]), "every visit draws its own views and symmetries"


def test_views_are_drawn_without_repetition_and_equal_shares(data: Dataset) -> None:
    with pytest.raises(TrilightError, match="not divisible by 4 ranks"):
        take(data, SETTINGS, 1, world_size=4)
    settings = StreamSettings(seed=0, window=1, batch_size=7, resolution=8, views_per_scene=2)
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
    settings = dataclasses.replace(SETTINGS, augmentation=augmentation, network=network)
    plain = dataclasses.replace(settings, network=tiny_config())
    pairs = zip(take(data, settings, 1)[0], take(data, plain, 1)[0], strict=True)
    for scene, other in pairs:
        expected = with_albedo(other.tensors, 16, 2).albedo_VRR6
        assert expected is not None and scene.tensors.albedo_VRR6 is not None
        assert torch.equal(scene.tensors.albedo_VRR6, expected) and expected.max() > 0
        assert same(other, dataclasses.replace(scene, tensors=other.tensors))
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


def test_a_view_takes_its_target_and_noise_along_and_targets_are_logarithms() -> None:
    sample = toy_sample(4, resolution=16)
    target = training_scene(sample, 16).target_VRR3.numpy()
    np.testing.assert_allclose(10.0**target - 1, sample.radiance_rgb, atol=1e-6)  # float32 log
    floors = (dataclasses.replace(sample.views[0], noise_floor_db=40.0), sample.views[1])
    scene = training_scene(dataclasses.replace(sample, views=floors), 16)
    torch.testing.assert_close(scene.noise_V, torch.tensor([1e-2, 1e-5]))
    most = sample.scene.num_triangles
    assert training_scene(sample, 16, most_triangles=most).tensors.num_triangles == most
    with pytest.raises(TrilightError, match=f"{most} triangles; the run takes at most {most - 1}"):
        training_scene(sample, 16, most_triangles=most - 1)
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
    settings = AugmentationSettings(
        mirror=True,
        channels=True,
        vertex_order=True,
        light_scale=3.0,
        light_mix=2.0 if lights_apart else 1.0,
        rotation="uniform",
    )
    rows_seen = 0
    for seed, resolution in enumerate((16, 16, 8, 16)):
        full = training_scene(whole, resolution, lights_apart=lights_apart)
        drawn = scene_of_views(stored, [0, 2], resolution, per_light=lights_apart)
        rows_seen += drawn.levels_L is not None
        wanted = augment_scene(full, settings, np.random.default_rng(seed))
        got = with_target(augment_scene(drawn, settings, np.random.default_rng(seed)))
        assert torch.equal(got.target_VRR3, wanted.target_VRR3[[0, 2]]) and got.levels_L is None
        assert torch.equal(got.noise_V, wanted.noise_V[[0, 2]])
        for name, tensor in tensors_of(wanted.tensors).items():
            wanted_tensor = tensor[[0, 2]] if name in ("c2w_V44", "fov_deg_V") else tensor
            assert torch.equal(getattr(got.tensors, name), wanted_tensor)
    assert rows_seen == 3


def test_what_is_no_half_float_is_no_row() -> None:
    """Zeros with a sign are zeros; a picture of another tool's float32 is computed as it is."""
    sample = toy_sample(1, resolution=8)
    radiance = sample.radiance_rgb.copy()
    radiance[0, 0, 0] = -0.0
    members = encode_sample(dataclasses.replace(sample, radiance_rgb=radiance))
    drawn = with_target(scene_of_views(stored_sample("1", members), [0], 8))
    assert drawn.target_VRR3[0, 0, 0].tolist() == [0.0, 0.0, 0.0]
    members["1.exr"] = encode_channels({"RGB": sample.radiance_rgb[1]})
    mixed = scene_of_views(stored_sample("1", members), [0, 1], 8)
    assert mixed.levels_L is None
    wanted = torch.from_numpy(np.log10(1 + sample.radiance_rgb[1]).astype(np.float32))
    assert torch.equal(mixed.target_VRR3[1], wanted)
