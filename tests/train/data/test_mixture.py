"""Laws of a stream of several datasets: shares, each one's own order, and going on anywhere."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import pytest
import torch

from model.checkpoint_format import path_of_step
from storage.dataset.mixed_data import open_mixture
from storage.dataset.training_data import TrainingData
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.train.data.test_stream import by_key, identity, same_batches
from tests.train.kit import keys_of, take, tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.data.bad_samples import BadSampleCounter, first_samples
from train.data.mixture import RECORD, Mixture, plan_mixture
from train.data.scenes import TrainingScene
from train.data.stream import StreamSettings
from train.loop.checkpoints import read_checkpoint
from train.resume import StartOptions
from train.run import train_run

BATCH = 4
SETTINGS = StreamSettings(seed=1, window=2, batch_size=BATCH, resolution=16, views_per_scene=1)


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two datasets; the second is smaller, of larger pictures, and has other views."""
    first, second = (tmp_path_factory.mktemp(name) for name in ("first", "second"))
    write_toy_dataset(first, train=7, validation=2, per_shard=2, resolution=16)
    write_toy_dataset(second, train=3, validation=1, per_shard=2, resolution=32)
    return [str(first), str(second)]


@pytest.fixture(scope="module")
def data(roots: list[str]) -> TrainingData:
    return open_mixture(roots)


def mixture(*weights: float, **changes: object) -> Mixture:
    few = Mixture(
        digests=tuple(f"{row}" for row in range(len(weights))),
        names=tuple("abc"[: len(weights)]),
        weights=weights,
        before=(0,) * len(weights),
        scenes_per_step=BATCH,
    )
    return dataclasses.replace(few, **changes)  # type: ignore[arg-type]


@for_each("weights", [(1.0,), (3.0, 1.0), (0.1, 0.2, 0.7), (1e-3, 5.0), (7.0, 3e5)])
def test_every_stretch_has_its_shares_and_may_be_entered_anywhere(
    weights: tuple[float, ...],
) -> None:
    mixed = mixture(*weights)
    turns = list(itertools.islice(mixed.sources_from(0), 3000))
    for at in (0, 1, 17, 999, 2990):
        counts = tuple(turns[:at].count(source) for source in range(len(weights)))
        assert mixed.counts_before(at) == counts
        assert list(itertools.islice(mixed.sources_from(at), 10)) == turns[at : at + 10]
        for source, weight in enumerate(weights):
            assert abs(counts[source] - at * weight / sum(weights)) < len(weights)
    far = 10**15
    assert sum(mixed.counts_before(far)) == far, "in the time of the first"


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
    turns = list(itertools.islice(mixture(*WEIGHTS).sources_from(0), len(scenes)))
    assert [turns.count(source) for source in (0, 1)] == [24, 12]
    for source, root in enumerate(roots):
        alone = list(itertools.chain(*keys_of(take(open_mixture([root]), SETTINGS, 6))))
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
    assert same_batches(take(data, SETTINGS, count, workers=3, **part), whole[first:])
    shares = [take(data, SETTINGS, count, rank=rank, world_size=2, **part) for rank in (0, 1)]
    for wanted, *parts in zip(whole[first:], *shares, strict=True):
        got = by_key([scene for part in parts for scene in part])
        assert [*map(identity, got)] == [*map(identity, by_key(wanted))]


def test_first_samples_come_from_every_dataset(data: TrainingData) -> None:
    shards = data.split("train")
    shown = [
        sample.radiance_rgb.shape[1] for sample in first_samples(shards, 5, BadSampleCounter(0))
    ]
    assert shown == [16, 16, 16, 32, 32]
    assert len(list(first_samples(data.split("validation"), 99, BadSampleCounter(0)))) == 3


def test_a_dataset_that_is_known_goes_on_where_it_was(roots: list[str], data: TrainingData) -> None:
    """One alone, then two, then other weights, then the second alone."""
    run = tiny_run(scenes_per_step=BATCH)
    alone = [open_mixture([root]) for root in roots]
    header = {"step": 0, "settings": {"scenes_per_step": BATCH}, "data_digest": alone[0].digest}
    assert plan_mixture(alone[0], run, None) is None
    assert plan_mixture(alone[0], run, header | {"step": 5}) is None
    two = plan_mixture(data, run, header | {"step": 5})
    assert two is not None and two.weights == (7.0, 3.0), "shares as their numbers of scenes"
    assert (two.first, two.before) == (20, (20, 0))
    later = header | {"step": 10, RECORD: two.record(), "data_digest": data.digest}
    assert plan_mixture(data, run, later) == two
    weighed = dataclasses.replace(run, data_weights=(1, 1))
    other = plan_mixture(data, weighed, later)
    assert other is not None and (other.first, other.before) == (40, (34, 6))
    wider = plan_mixture(data, tiny_run(scenes_per_step=2 * BATCH), later)
    assert wider is not None and (wider.first, wider.before) == (80, (34, 6))
    second = plan_mixture(alone[1], run, later)
    assert second is not None and second.before == (6,) and second.counts_before(44) == (10,)


def test_mistakes_about_several_datasets(roots: list[str], data: TrainingData) -> None:
    with pytest.raises(TrilightError, match="holds the same dataset as .*data_weights says"):
        open_mixture([roots[0], roots[1], roots[0]])
    with pytest.raises(TrilightError, match="2 places of which 1 are shards"):
        open_mixture([roots[0], f"{roots[1]}/train-000000.tar"])
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
    mixed, unusable = open_mixture([str(tmp_path / "a"), str(tmp_path / "b")]), BadSampleCounter(2)
    turns = list(itertools.islice(mixture(1.0, 1.0).sources_from(0), 16))
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
    uninterrupted = trained(settings, roots, out).folder.weights.read_bytes()
    path_of_step(out / "checkpoints", 8).unlink()
    (out / "model.safetensors").unlink()
    resumed = trained(settings, roots, out, resume=True, workers=3)
    assert resumed.folder.weights.read_bytes() == uninterrupted
    header = read_checkpoint(path_of_step(out / "checkpoints", 8)).header
    assert header["data_digest"].startswith("mix:") and len(header[RECORD]["digests"]) == 2
    (tmp_path / "third").mkdir()
    write_toy_dataset(tmp_path / "third", train=2, validation=1, per_shard=2, resolution=16)
    three = [*roots, str(tmp_path / "third")]
    digest = open_mixture(three).digest
    with pytest.raises(TrilightError, match=r"--change data=mix:[0-9a-f]{12}"):
        train_run(settings, data=three, out=out, start=StartOptions(resume=True))
    decided = {"data": digest[:16], "data_weights": (1.0, 2.0, 1.0), "num_steps": 10}
    train_run(settings, data=three, out=out, start=StartOptions(resume=True, decisions=decided))
    header = read_checkpoint(path_of_step(out / "checkpoints", 10)).header
    assert header[RECORD]["first"] == 24 and header[RECORD]["before"] == [8, 16, 0]
