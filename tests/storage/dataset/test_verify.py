"""Verifying: every bad shard, sample and map is named, and nothing that is whole."""

import dataclasses
import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.dataset import verify
from storage.dataset.dataset import Dataset, open_dataset, reading
from storage.dataset.manifest import index_shard, read_manifest, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.verify import Verification, verify_dataset
from storage.digests import sha256_hex, sha256_of_file
from storage.errors import TrilightError, Unreadable
from storage.records.packed_maps import map_member, pack_map
from storage.records.sample import encode_sample, sample_key
from storage.seeds import rng_for
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes, write_dataset
from tests.storage.dataset.test_shard import TRAIN, four_samples
from tests.textured_by_hand import number_texture, sky, textured_sample


def opened(made: Dataset) -> Dataset:
    digest = sha256_hex(made.folder.objects_lock.read_bytes())
    return open_dataset(str(edit_manifest(made, objects_lock_sha256=digest)))


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return opened(five_scenes(tmp_path))


def replace_shard(
    dataset: Dataset, name: str, samples: Iterable[tuple[str, dict[str, bytes]]]
) -> None:
    """Write a shard anew, and have the manifest agree."""
    dataset.folder.shard(name).unlink()  # a shard is never written over
    write_shard(dataset.folder.shard(name), samples)
    shards = tuple(
        index_shard(dataset.folder.shard(shard.name)) for shard in dataset.manifest.shards
    )
    write_manifest(dataset.folder.manifest, dataclasses.replace(dataset.manifest, shards=shards))


def rewrite(
    dataset: Dataset,
    name: str,
    change: Callable[[str, dict[str, bytes]], object],
    key: Callable[[str], str] = str,
) -> Verification:
    """Pack a shard anew with changed members, have the manifest agree, and verify."""
    (entry,) = [shard for shard in dataset.manifest.shards if shard.name == name]
    samples = []
    for sample in dataset.read_shard(entry):
        members = encode_sample(sample)
        change(sample.key, members)
        samples.append((key(sample.key), members))
    replace_shard(dataset, name, samples)
    return verify_dataset(dataset.folder.root)


def test_a_whole_dataset_has_no_fault_and_every_shard_is_looked_at(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verify, "_AHEAD", 1)
    for fast in (False, True):
        looked: list[str] = []
        found = verify_dataset(dataset.folder.root, fast=fast, shard_done=looked.append)
        assert (found.problems, found.bad_shards, found.manifest.num_samples) == ([], [], 5)
        assert looked == [shard.name for shard in dataset.manifest.shards]


def test_only_what_was_read_whole_is_called_damaged(dataset: Dataset) -> None:
    for error, is_damage in ((RecursionError(), True), (Unreadable("no answer."), False)):
        with pytest.raises(TrilightError) as caught, reading("set", "a.tar"):
            raise error
        assert ("is damaged" in str(caught.value)) == is_damage
    write_manifest(dataset.folder.manifest, dataset.manifest)  # with a seal
    dataset = open_dataset(str(dataset.folder.root))
    write_manifest(dataset.folder.manifest, dataclasses.replace(dataset.manifest, num_scenes=9))
    found = verify_dataset(dataset)
    assert (found.problems, found.manifest.num_samples) == ([], 5)
    rewrite(dataset, "train-000000.tar", lambda key, members: None, key=lambda key: f"1{key[1:]}")
    with pytest.raises(TrilightError, match=r"written while the shards .* Verify it again\."):
        verify_dataset(dataset)


def test_every_bad_sample_of_every_bad_shard_is_named(dataset: Dataset) -> None:
    def spoil(key: str, members: dict[str, bytes]) -> None:
        if key in ("000000000", "000000001", "000000003"):
            members["0.exr"] = b"no picture"

    rewrite(dataset, "train-000000.tar", spoil)
    found = rewrite(dataset, "train-000001.tar", spoil)
    assert found.bad_shards == ["train-000000.tar", "train-000001.tar"]
    named = [problem.split(":")[:2] for problem in found.problems]
    assert named == [
        ["train-000000.tar", " sample 000000000"],
        ["train-000000.tar", " sample 000000001"],
        ["train-000001.tar", " sample 000000003"],
    ]
    assert verify_dataset(dataset.folder.root, fast=True).problems == []


def test_a_key_in_two_shards_is_named(dataset: Dataset) -> None:
    found = rewrite(dataset, "train-000001.tar", lambda *_: None, lambda key: key.replace("2", "0"))
    assert found.bad_shards == ["train-000001.tar"]
    assert "sample 000000000 occurs twice in the dataset, first in" in found.problems[0]


@pytest.mark.parametrize("fast", [False, True])
def test_the_lock_sizes_counts_and_members_are_compared(dataset: Dataset, fast: bool) -> None:
    path = dataset.folder.objects_lock
    path.write_bytes(path.read_bytes()[:-2] + b" }\n")  # the same rows in other bytes
    for fault in ("sha256 differs from the manifest", "missing"):
        found = verify_dataset(dataset.folder.root, fast=fast)
        assert found.problems == [f"objects.lock.jsonl: {fault}"] and not found.bad_shards
        path.unlink(missing_ok=True)
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
    assert f"samples; expected {shards[0]['num_samples']}" in text
    assert f"{shards[1]['name']}: not a readable shard (a header at byte 0)" in text
    assert f"{shards[2]['name']}: missing" in text
    assert "train-000007.tar: not in the manifest" in text


def test_every_flipped_bit_beside_the_shards_is_found(tmp_path: Path) -> None:
    folder = opened(five_scenes(tmp_path)).folder
    for path in (folder.attribution, folder.licences, folder.croissant, folder.card):
        path.write_text("\u00e9 1e-05")
    manifest = read_manifest(folder.manifest)
    names = ("LICENSE.md", "README.md", "attribution.csv", "croissant.json")
    documents = {name: sha256_of_file(tmp_path / name) for name in names}
    environment = {"host": "\u00e9", "least": 1e-05}
    manifest = dataclasses.replace(manifest, environment=environment, documents=documents)
    write_manifest(folder.manifest, manifest)
    assert verify_dataset(tmp_path, fast=True).problems == []
    rng = rng_for(1, "flipped bits")
    for name, count in {"manifest.json": 300, **dict.fromkeys(names, 8)}.items():
        data = (tmp_path / name).read_bytes()
        for bit in map(int, rng.integers(8 * len(data), size=count)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            (tmp_path / name).write_bytes(flipped)
            try:
                found = verify_dataset(tmp_path, fast=True).problems
            except TrilightError as error:
                found = [str(error)]
            assert found and "\n" not in "".join(found), (name, bit)
        (tmp_path / name).write_bytes(data)
    folder.card.unlink()
    assert verify_dataset(tmp_path).problems == ["README.md: missing"]


def test_a_manifest_that_contradicts_itself_or_says_no_pictures_is_a_fault(
    dataset: Dataset,
) -> None:
    """Also one of before there was a seal."""
    lies: dict[str, Callable[[dict[str, Any]], object]] = {
        "dataset_digest is 0+; its shards": lambda record: record.update(dataset_digest="0" * 64),
        "settings have": lambda record: record["settings"].update(seed=999),
        "totals are .*samples=7": lambda record: record["totals"].update(samples=7),
        "is listed 2 times": lambda record: record["shards"].append(record["shards"][0]),
    }
    path = dataset.folder.manifest
    whole = path.read_bytes()
    for fault, lie in lies.items():
        record = json.loads(whole)
        lie(record)
        path.write_text(json.dumps(record))
        found = verify_dataset(dataset.folder.root).problems
        assert any(re.search(f"manifest.json: .*{fault}", problem) for problem in found), found
    for renders in (None, 3, dict[str, Any]()):
        settings = {**dataset.manifest.settings, "renders": renders}
        write_manifest(path, dataclasses.replace(dataset.manifest, settings=settings))
        found = verify_dataset(dataset.folder.root).problems
        assert any("pictures (" in problem for problem in found), renders


SKY, ROUGHNESS = map_member(sky().sha256), map_member(number_texture().sha256)
Change = Callable[[str, dict[str, bytes]], object]


@pytest.fixture
def mapped(tmp_path: Path) -> Dataset:
    made = write_dataset(
        tmp_path, {TRAIN: four_samples(), "test-000001.tar": [textured_sample("000000004")]}
    )
    return opened(made)


def _spoil_sky(_: str, members: dict[str, bytes]) -> None:
    """Put a sky of one wrong value, named as its content is, in the place of the right one."""
    other = sky(radiance_rgb=np.full((2, 4, 3), np.nan, np.float32))
    if members.pop(SKY, None) is not None:
        members["json"] = members["json"].replace(sky().sha256.encode(), other.sha256.encode())
        members[map_member(other.sha256)] = pack_map(other)


@pytest.mark.parametrize(
    ("change", "message", "rows"),
    [
        (lambda _, each: each.pop(ROUGHNESS, None), "is missing; expected a member", (1, 2, 3)),
        (_spoil_sky, r"radiance_rgb\[0, 0, 0\] is nan; expected finite", (1, 2)),
    ],
)
def test_a_wrong_map_is_a_finding_of_each_sample_that_has_it(
    mapped: Dataset, change: Change, message: str, rows: tuple[int, ...]
) -> None:
    """Of those that read for people too: `inspect` ends with one line that names the sample.

    test_packed_maps has more that may be wrong.
    """
    assert verify_dataset(mapped.folder.root).problems == []
    problems = rewrite(mapped, TRAIN, change).problems
    assert [line.split(": ")[1] for line in problems] == [f"sample {sample_key(k)}" for k in rows]
    assert all(re.search(message, line) for line in problems), problems
    with pytest.raises(TrilightError, match="trilight verify") as caught:
        list(open_dataset(str(mapped.folder.root)).scenes())
    assert re.search(message, str(caught.value)) and sample_key(1) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_map_that_nobody_uses_is_a_finding(mapped: Dataset) -> None:
    unused = map_member("0" * 64)
    found = rewrite(mapped, TRAIN, lambda _, members: members.update({unused: b"x"}))
    assert found.problems == [f"{TRAIN}: map {unused} is used by no sample"]
