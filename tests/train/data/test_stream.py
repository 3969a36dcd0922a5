"""Laws of the stream: batch i is the same scenes for ever, and errors arrive where they belong."""

import dataclasses
import threading
from collections.abc import Iterator

import pytest
import torch

from model.demodulated import with_albedo
from model.scene_tensors import tensors_of
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import tiny_config
from tests.train.kit import take
from tests.train.toy import write_toy_dataset
from train.data.scenes import TrainingScene
from train.data.stream import StreamSettings, prefetched
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
    assert threading.active_count() == before, "closing the stream ends its threads"


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


def test_ranks_that_cannot_share_equally_are_refused(data: Dataset) -> None:
    with pytest.raises(TrilightError, match="not divisible by 4 ranks"):
        take(data, SETTINGS, 1, world_size=4)


def test_a_bug_in_the_thread_is_not_swallowed() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise RuntimeError("a bug")

    items = prefetched(broken(), 2)
    assert next(items) == 1
    with pytest.raises(RuntimeError, match="a bug"):
        next(items)


def test_views_are_drawn_without_repetition(data: Dataset) -> None:
    settings = StreamSettings(seed=0, window=1, batch_size=7, resolution=8, views_per_scene=2)
    for scene in take(data, settings, 1)[0]:
        poses = scene.tensors.c2w_V44.numpy()
        assert poses.shape[0] == 2
        assert abs(poses[0] - poses[1]).max() > 0


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
