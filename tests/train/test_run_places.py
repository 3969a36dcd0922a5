"""A run from a server, or from a list, is the run from the folder."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load

from storage.dataset.dataset import Dataset
from storage.dataset.training_data import NO_MANIFEST
from storage.errors import TrilightError
from storage.remote import tries
from tests.http_server import Fault, Site, serve
from tests.train.kit import tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.progress import TrainProgress

pytest.importorskip("aiohttp", reason="http needs the package aiohttp")


SHARDS_OF_THREE = ("train-000000.tar", "train-000001.tar")


RUN = tiny_run(num_steps=8, validate_every=8)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)


@pytest.fixture(scope="module")
def weights(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The weights of the run from the folder, uninterrupted."""
    out = tmp_path_factory.mktemp("whole")
    return trained(RUN, [str(dataset.folder.root)], out).folder.weights.read_bytes()


@pytest.fixture
def server(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(tries, "PAUSE_S", 0.0)
    with serve(dataset.folder.root) as running:
        yield running


class StopAt(TrainProgress):
    def __init__(self, step: int) -> None:
        self.step = step
        self.notes: list[str] = []

    def noted(self, text: str) -> None:
        self.notes.append(text)

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        if step == self.step:
            raise KeyboardInterrupt


def test_a_run_begun_in_a_folder_goes_on_from_a_server(
    dataset: Dataset, weights: bytes, server: Site, tmp_path: Path
) -> None:
    """In the middle of an epoch, over a bad line, with another number of threads."""
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        trained(RUN, [str(dataset.folder.root)], out, progress=StopAt(5))
    faults = [Fault(status=503), Fault(cut_after=5000), Fault(flip=True)]
    server.faults = {f"/train-{number:06d}.tar": list(faults) for number in range(3)}
    result = trained(RUN, [server.url], out, resume=True, workers=3)
    assert result.folder.weights.read_bytes() == weights
    assert result.unusable == ()


def test_a_list_gives_the_same_weights_and_says_what_it_lacks(
    dataset: Dataset, weights: bytes, server: Site, tmp_path: Path
) -> None:
    listener = StopAt(99)
    pattern = f"{server.url}/{{train-000000,train-000001,train-000002,validation-000000}}.tar"
    result = trained(RUN, [pattern], tmp_path / "out", progress=listener)
    # the header alone differs: without a manifest nobody knows how large the scenes may be
    ours, theirs = load(result.folder.weights.read_bytes()), load(weights)
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[n], theirs[n]) for n in ours)
    lacks, *others = listener.notes
    assert lacks == NO_MANIFEST
    assert [note for note in others if "decode" not in note] == []  # how many threads do
    with pytest.raises(TrilightError, match=r"made with list:\w{12}\..* --change data=sha256:"):
        trained(RUN, [str(dataset.folder.root)], tmp_path / "out", resume=True)


def test_damaged_data_is_left_out_when_it_is_allowed(dataset: Dataset, tmp_path: Path) -> None:
    root = tmp_path / "damaged"
    copied = write_toy_dataset(root, train=7, validation=2, per_shard=3)
    path = copied.folder.shard("train-000002.tar")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(TrilightError, match=r"train-000002\.tar.*sha256"):
        trained(RUN, [str(root)], tmp_path / "a")
    result = trained(dataclasses.replace(RUN, most_unusable=1), [str(root)], tmp_path / "b")
    (message,) = result.unusable
    assert "train-000002.tar" in message
    assert message in result.folder.summary.read_text().replace("\\n", "\n")


def test_the_budget_of_damage_is_the_run_s_and_not_the_process_s(
    dataset: Dataset, tmp_path: Path
) -> None:
    """Damage that was met before a stop counts after it, though it is whole again by then."""
    root, out = tmp_path / "damaged", tmp_path / "out"
    copied = write_toy_dataset(root, train=7, validation=2, per_shard=3)
    whole = {name: copied.folder.shard(name).read_bytes() for name in SHARDS_OF_THREE}

    def damage(name: str) -> None:
        data = bytearray(whole[name])
        data[len(data) // 2] ^= 1
        copied.folder.shard(name).write_bytes(data)

    first, second = SHARDS_OF_THREE
    settings = dataclasses.replace(RUN, most_unusable=3)
    damage(first)
    with pytest.raises(KeyboardInterrupt):
        trained(settings, [str(root)], out, progress=StopAt(5))
    copied.folder.shard(first).write_bytes(whole[first])
    damage(second)
    with pytest.raises(TrilightError, match="6 samples are unusable; expected at most 3"):
        trained(settings, [str(root)], out, resume=True)
    copied.folder.shard(second).write_bytes(whole[second])
    damage(first)
    assert len(trained(settings, [str(root)], out, resume=True).unusable) == 1
