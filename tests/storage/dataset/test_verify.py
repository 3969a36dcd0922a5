"""Verifying: every bad shard and sample is named, and nothing that is whole."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.records.sample import encode_sample
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = five_scenes(tmp_path)
    digest = sha256_hex(made.folder.objects_lock.read_bytes())
    return open_dataset(str(edit_manifest(made, objects_lock_sha256=digest)))


def rewrite(dataset: Dataset, name: str, change: Callable[[str, dict[str, bytes]], str]) -> None:
    """Pack a shard anew with changed members, and have the manifest agree."""
    (entry,) = [shard for shard in dataset.manifest.shards if shard.name == name]
    samples = []
    for sample in dataset.read_shard(entry):
        members = encode_sample(sample)
        samples.append((change(sample.key, members), members))
    dataset.folder.shard(name).unlink()  # a shard is never written over
    write_shard(dataset.folder.shard(name), samples)
    shards = tuple(
        index_shard(dataset.folder.shard(shard.name)) for shard in dataset.manifest.shards
    )
    write_manifest(dataset.folder.manifest, dataclasses.replace(dataset.manifest, shards=shards))


def test_a_whole_dataset_has_no_fault_and_every_shard_is_looked_at(dataset: Dataset) -> None:
    for fast in (False, True):
        looked: list[str] = []
        found = verify_dataset(dataset.folder.root, fast=fast, shard_done=looked.append)
        assert (found.problems, found.bad_shards, found.num_samples) == ([], [], 5)
        assert looked == [shard.name for shard in dataset.manifest.shards]


def test_every_bad_sample_of_every_bad_shard_is_named(dataset: Dataset) -> None:
    def spoil(key: str, members: dict[str, bytes]) -> str:
        if key in ("000000000", "000000001", "000000003"):
            members["0.exr"] = b"no picture"
        return key

    rewrite(dataset, "train-000000.tar", spoil)
    rewrite(dataset, "train-000001.tar", spoil)
    found = verify_dataset(dataset.folder.root)
    assert found.bad_shards == ["train-000000.tar", "train-000001.tar"]
    named = [problem.split(":")[:2] for problem in found.problems]
    assert named == [
        ["train-000000.tar", " sample 000000000"],
        ["train-000000.tar", " sample 000000001"],
        ["train-000001.tar", " sample 000000003"],
    ]
    assert verify_dataset(dataset.folder.root, fast=True).problems == []


def test_a_key_in_two_shards_is_named(dataset: Dataset) -> None:
    rewrite(dataset, "train-000001.tar", lambda key, _: key.replace("2", "0"))
    found = verify_dataset(dataset.folder.root)
    assert found.bad_shards == ["train-000001.tar"]
    assert "sample 000000000 occurs twice in the dataset, first in" in found.problems[0]


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize(
    ("lock", "fault"),
    [(lambda old: old[:-2] + b" }\n", "sha256 differs from the manifest"), (None, "missing")],
    ids=["the same rows in other bytes", "gone"],
)
def test_the_lock_is_compared(
    dataset: Dataset, fast: bool, lock: Callable[[bytes], bytes] | None, fault: str
) -> None:
    path = dataset.folder.objects_lock
    if lock is None:
        path.unlink()
    else:
        path.write_bytes(lock(path.read_bytes()))
    found = verify_dataset(dataset.folder.root, fast=fast)
    assert f"objects.lock.jsonl: {fault}" in found.problems, found.problems


@pytest.mark.parametrize("fast", [False, True])
def test_sizes_counts_and_members_are_compared(dataset: Dataset, fast: bool) -> None:
    root = dataset.folder.root
    shards = json.loads(dataset.folder.manifest.read_text())["shards"]
    shards[0]["num_samples"] += 1
    edit_manifest(dataset, shards=shards)
    path = dataset.folder.shard(shards[1]["name"])
    path.write_bytes(b"x" + path.read_bytes()[1:])  # the name of its first member
    dataset.folder.shard(shards[2]["name"]).unlink()
    (root / "train-000007.tar").write_bytes(b"")
    found = verify_dataset(root, fast=fast)
    assert found.bad_shards == [shard["name"] for shard in shards]
    text = "\n".join(found.problems)
    assert (f"{shards[0]['name']}: " in text and "number of samples differs" in text) or fast
    assert f"samples; expected {shards[0]['num_samples']}" in text or not fast
    assert f"{shards[1]['name']}: not a readable shard (a header at byte 0)" in text
    assert f"{shards[2]['name']}: missing" in text
    assert "train-000007.tar: not in the manifest" in text


@pytest.mark.parametrize("renders", [None, 3, {}])
def test_a_manifest_that_does_not_say_what_its_pictures_are_is_a_fault(
    dataset: Dataset, renders: object
) -> None:
    settings = {**dataset.manifest.settings, "renders": renders}
    manifest = dataclasses.replace(dataset.manifest, settings=settings)
    write_manifest(dataset.folder.manifest, manifest)
    problems = verify_dataset(dataset.folder.root).problems
    assert any("pictures (" in problem for problem in problems)
