"""Manifests, splits and what is read through them: the same for any cut, and nothing moves.

How far a dataset is, from its files alone: counts, the rate of the last scenes, cut rows.
"""

import dataclasses
import io
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.conventions import SPLITS
from storage.dataset import progress
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import (
    Manifest,
    ShardEntry,
    decode_head,
    read_head,
    read_manifest,
    write_manifest,
)
from storage.dataset.progress import (
    announce_downloads,
    announce_objects,
    count_given_up,
    count_object,
    log_scene,
    missing_shards,
    read_progress,
    read_status,
    sample_logs,
    tell_views,
    write_asked,
)
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import (
    named_shard,
    require_objects,
    scenes_of_shard,
    shard_name,
    shards_for,
    split_of_object,
    split_of_shard,
)
from storage.dataset.staging import note_of
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.remote.store import RemoteStore
from storage.seeds import rng_for, seed_for
from tests.command_line import run_program
from tests.for_each import case
from tests.http_server import serve
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes
from tests.pipeline.generation.test_dataset_writer import begin_tiny, make_tiny_shard

SAMPLES_PER_SHARD = 256
SAMPLE_BYTES = 150_000
"""A sample of four small pictures takes about as much."""


def write_manifest_of(root: Path, num_samples: int) -> None:
    """Write the manifest of a dataset whose every scene is for training."""
    firsts = range(0, num_samples, SAMPLES_PER_SHARD)
    counts = [min(SAMPLES_PER_SHARD, num_samples - first) for first in firsts]
    shards = tuple(
        ShardEntry(
            name=named_shard(number, "train"), split="train", num_samples=count,
            num_bytes=count * SAMPLE_BYTES + 10_240, sha256=f"{number:064x}",
        )
        for number, count in enumerate(counts)
    )  # fmt: skip
    manifest = Manifest(
        build="bench", settings={}, environment={}, num_scenes=num_samples, num_views=4,
        objects_lock_sha256="", shards=shards,
    )  # fmt: skip
    write_manifest(DatasetFolder(root).manifest, manifest)


OPENING = """
import sys
from storage.dataset.training_data import open_training_data
open_training_data([sys.argv[2]])  # the reader by type takes 10 MB, once
def peak_bytes():
    # not getrusage: its peak counts the parent too, from before this program was begun
    lines = open("/proc/self/status").read().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
before = peak_bytes()
data = open_training_data([sys.argv[1]])
print(peak_bytes() - before)
"""


def test_a_head_is_read_without_the_list_and_rows_with_an_index(tmp_path: Path) -> None:
    write_manifest_of(tmp_path, 5_000)
    path = tmp_path / "manifest.json"
    whole, head = read_manifest(path), read_head(path)
    assert len(whole.shards) == 20 and head == dataclasses.replace(whole, shards=())
    cut = path.read_bytes()[: path.read_bytes().index(b"train-000001")]  # as a maker fetches it
    assert decode_head(io.BytesIO(cut), "here") == head
    # as manifests were before version 5
    record = json.loads(path.read_bytes())
    for row in record["shards"]:
        row["members"] = [["000000000.json", 512, 9]]
    older = tmp_path / "older.json"
    older.write_text(json.dumps({**record, "schema_version": 4}, indent=1, sort_keys=True))
    found = read_manifest(older)
    assert found.schema_version == 4 and found.shards == read_manifest(path).shards
    write_manifest(older, found)
    assert older.read_bytes() == path.read_bytes()


def test_opening_a_large_dataset_takes_few_bytes_a_sample(tmp_path: Path) -> None:
    """A shard takes 200 of the manifest."""
    write_manifest_of(tmp_path / "large", 100_000)
    assert (tmp_path / "large" / "manifest.json").stat().st_size < 391 * 220
    write_manifest_of(tmp_path / "small", 1)
    command = [sys.executable, "-c", OPENING, str(tmp_path / "large"), str(tmp_path / "small")]
    # 391 shards; measured: 17, nearly all of it a piece of the text
    assert int(run_program(command).stdout) < 100_000 * 40


LIES: dict[str, Any] = {
    "num_scenes": (-5, 10**15, "4", 4.0, True, None, math.nan, math.inf),
    "num_views": (0, -1, 10**9, "one"),
    "settings": (None, [], 3, {"seed": math.nan}),
    "build": (5, "x" * 5_000, "x" * 20_000_000),
    "environment": (None, 7),
    "extensions": (["a"], {"evil.py": 7}),
    "documents": ({"../x": "0" * 64}, {"README.md": 1}),
    "objects_lock_sha256": (1, "../x"),
    "dataset_digest": (None, 3),
    "evil": (1,),
    "shards.num_samples": (-3, 10**12, 2.0, None, True, "2"),
    "shards.num_bytes": (-1, "61440", 2**63),
    "shards.split": ("../x", ["train"]),
    "shards.sha256": (7, "../x", "A" * 64),
    "shards.name": (
        "../train-000000.tar",
        "part-0001/../train-000000.tar",
        "/train-000000.tar",
        "x",
        "part-1/train-000000.tar",
        "a/train-000000.tar",
        "part-0001/part-0001/train-000000.tar",
        "pipe:train-000000.tar",
        "train-000000.tar\n",
        ["train-000000.tar"],
    ),
    "shards.evil": (1,),
}
"""Values that a manifest does not have, by field."""


def test_a_manifest_that_lies_or_is_none_is_one_sentence_within_a_second(tmp_path: Path) -> None:
    write_manifest_of(tmp_path, 5)
    path = tmp_path / "manifest.json"
    whole = path.read_bytes()
    for field, value in [(field, value) for field, values in LIES.items() for value in values]:
        record, name = json.loads(whole), field.rpartition(".")[2]
        (record if "." not in field else record["shards"][0])[name] = value
        path.write_text(json.dumps(record, sort_keys=True))
        began = time.process_time()
        with case((field, value)), pytest.raises(TrilightError) as caught:
            read_manifest(path)
        assert time.process_time() - began < 1
        said = str(caught.value)
        assert said.startswith(f"{path}: ") and "\n" not in said and len(said) < 600
        assert name in said or "bytes are too many" in said
    for text in ("", "[" * 100_000, "[]", "{}", "3", '{"schema_version": 3}', "\\", "{}{}"):
        path.write_text(text)
        with case(text), pytest.raises(TrilightError, match=r"^[^\n]*manifest.json: [^\n]*$"):
            read_manifest(path)


def test_a_billion_planned_shards_cost_nothing_and_version_2_is_read(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    settings = {"splits": {"scenes_per_shard": 1}}
    edit_manifest(dataset, settings=settings, num_scenes=10**9)
    with pytest.raises(TrilightError, match="1000000000 shards; expected at most 1000000"):
        missing_shards(str(tmp_path))
    older = open_dataset(str(edit_manifest(dataset, schema_version=2))).manifest
    assert (older.num_samples, older.schema_version) == (5, 2)
    edit_manifest(dataset, schema_version=1)
    with pytest.raises(TrilightError, match=r"manifest.*version 1; .* reads 2, 3, 4 and 5"):
        open_dataset(str(tmp_path))


SETTINGS = SplitSettings(scenes_per_shard=4)


@given(st.integers(1, 100_000), st.integers(1, 300))
def test_whole_shards_hold_every_scene(num_scenes: int, scenes_per_shard: int) -> None:
    settings = SplitSettings(scenes_per_shard=scenes_per_shard)
    count = shards_for(num_scenes, settings)
    assert (count - 1) * scenes_per_shard < num_scenes <= count * scenes_per_shard
    here, following = (scenes_of_shard(index, settings) for index in (count, count + 1))
    assert here.stop == following.start and len(here) == scenes_per_shard


@given(st.integers(0, 1000))
def test_every_cycle_has_each_split(cycle: int) -> None:
    first = cycle * SETTINGS.shards_per_cycle
    splits = [split_of_shard(first + i, SETTINGS) for i in range(SETTINGS.shards_per_cycle)]
    assert set(splits) == set(SPLITS)
    assert splits.count("validation") == splits.count("test") == 1


def test_a_small_dataset_has_all_splits_in_shares_and_one_without_objects_is_named() -> None:
    names = [shard_name(index, SETTINGS) for index in range(shards_for(24, SETTINGS))]
    assert {name.split("-")[0] for name in names} == set(SPLITS)
    with pytest.raises(TrilightError, match="split 'validation': none of the 5"):
        require_objects({"train": 5}, {"train", "validation"})
    require_objects({"train": 5}, {"train"})
    splits = [split_of_object(sha256_hex(str(i).encode()), SETTINGS) for i in range(4000)]
    for split, share in (("train", 0.75), ("validation", 0.125), ("test", 0.125)):
        # 4000 draws: a standard error of at most 0.007, so 0.03 is over four of them
        assert abs(splits.count(split) / 4000 - share) < 0.03


def test_randomness_has_a_name() -> None:
    first = rng_for(0, "scene", 7, 0).random(4)
    assert (rng_for(0, "scene", 7, 0).random(4) == first).all()
    others = [rng_for(0, "scene", 7, 1), rng_for(1, "scene", 7, 0), rng_for(0, "camera", 7, 0)]
    assert all((other.random(4) != first).all() for other in others)
    assert rng_for(0, "scene", 70).random() != rng_for(0, "scene", 7, 0).random()
    assert 0 <= seed_for(0, "samples", 1) < 2**31


def test_a_miscounted_a_short_and_a_missing_shard_are_named(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    shards = json.loads(dataset.folder.manifest.read_text())["shards"]
    shards[0]["num_samples"] = 9
    found = open_dataset(str(edit_manifest(dataset, shards=shards)))
    with pytest.raises(TrilightError, match=r"[12] samples; expected 9.*trilight verify"):
        found.keys(found.manifest.shards[0])
    shard = dataset.manifest.shards[0]
    path = dataset.folder.shard(shard.name)
    path.write_bytes(path.read_bytes()[:4096])
    with pytest.raises(TrilightError, match=rf"{shard.name}.*cut short.*trilight verify"):
        list(dataset.read_scenes(shard))
    path.unlink()
    with pytest.raises(TrilightError, match=rf"{shard.name}.*trilight generate"):
        list(dataset.read_scenes(shard))


def test_downloads_and_objects_are_counted_from_the_start_of_each_run(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    now = read_progress(folder)
    assert (now.downloads_planned, now.objects_planned, now.scenes_planned) == (0, 0, 0)
    assert (now.downloads_done, now.objects_done, now.scenes_done) == (0, 0, 0)
    announce_downloads(folder, 2, 5)
    announce_objects(folder, 4)
    for _ in range(3):
        count_object(folder)
    now = read_progress(folder)
    assert (now.downloads_done, now.downloads_planned) == (2, 5)
    assert (now.objects_done, now.objects_planned) == (3, 4)
    count_object(folder, 4)  # another maker found them done
    assert read_progress(folder).objects_done == 4
    announce_objects(folder, 7)
    now = read_progress(folder)
    assert (now.objects_done, now.objects_planned) == (0, 7)
    folder.staged_plan.write_bytes(b'{"objects": "many"}')
    folder.staged_downloads.write_bytes(b"[1")
    now = read_progress(folder)
    assert (now.objects_planned, now.downloads_planned) == (0, 0)


def test_a_manifest_is_read_when_it_changes_and_not_twice_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publication, read = begin_tiny(tmp_path, 8), mock.Mock(wraps=read_manifest)
    monkeypatch.setattr(progress, "read_manifest", read)
    for _ in range(3):
        assert read_progress(publication.folder).scenes_planned == 8
    assert read.call_count == 1
    make_tiny_shard(publication, 0)
    now = read_progress(publication.folder)
    assert (now.scenes_done, now.scenes_planned, read.call_count) == (4, 8, 1)
    begin_tiny(tmp_path, 12)
    assert (read_progress(publication.folder).scenes_planned, read.call_count) == (12, 2)


def test_scenes_at_work_count_in_part(tmp_path: Path) -> None:
    """The bar moves within a scene; what a kill left long ago is not counted."""
    publication = begin_tiny(tmp_path, 8)
    folder = publication.folder
    assert read_progress(folder).views_done == 0
    tell_views(folder, 3, 0.25)
    tell_views(folder, 4, 1.5)
    now = read_progress(folder)
    assert (now.views_done, now.num_views) == (1.75, 2)
    make_tiny_shard(publication, 0)
    assert read_progress(folder).views_done == 4 * 2 + 1.75
    tell_views(folder, 3, None)
    tell_views(folder, 3, None)  # whoever comes second
    assert read_progress(folder).views_done == 4 * 2 + 1.5
    (left,) = (folder.staging / "at_work").iterdir()
    os.utime(left, (0, 0))
    assert read_progress(folder).views_done == 4 * 2
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / ".staging").write_text("in the way")
    for note in (lambda at: tell_views(at, 0, 0.5), lambda at: tell_views(at, 0, None)):
        note(DatasetFolder(tmp_path / "full"))  # where nothing can be written, nothing is told


def test_a_scene_that_is_given_up_during_a_count_is_not_subtracted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, walk = begin_tiny(tmp_path, 8).folder, os.walk

    def walk_and_give_up(top: Path) -> Iterator[Any]:
        yield from walk(top)
        count_given_up(folder, 0)

    monkeypatch.setattr(os, "walk", walk_and_give_up)
    assert read_progress(folder).scenes_done == 0


def test_shards_scenes_and_what_to_do_next(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path, 12)
    make_tiny_shard(publication, 1)
    found = read_status(str(tmp_path))
    assert found.views_per_hour is None
    assert (found.shards_done, found.shards_planned) == (1, 3)
    assert (found.scenes_done, found.scenes_planned) == (4, 12)
    assert (found.objects_done, found.objects_planned) == (0, 0)
    announce_objects(publication.folder, 7)
    count_object(publication.folder, 2)
    counted = read_status(str(tmp_path))
    assert (counted.objects_done, counted.objects_planned) == (2, 7)
    assert not found.finished
    assert found.next_words is None  # nobody wrote down how it was begun
    write_asked(publication.folder, ["generate", "smoke", "--scenes", "12"])
    begun = ("generate", "smoke", "--scenes", "12", "--out", str(tmp_path))
    assert read_status(str(tmp_path)).next_words == begun
    assert found.failures == [("scenes", "no_camera", 4)]
    # a shard without its note, as a kill leaves it
    note_of(publication.folder, "train-000001.tar").unlink()
    assert read_status(str(tmp_path)).shards_done == 1
    # a manifest that does not say how it is divided is refused
    path = publication.folder.manifest
    manifest = read_manifest(path)
    for splits in ({}, {"splits": {"shards": 3}}, {"splits": 3}):
        settings = {k: v for k, v in manifest.settings.items() if k != "splits"} | splits
        write_manifest(path, dataclasses.replace(manifest, settings=settings))
        with pytest.raises(TrilightError):
            read_status(str(tmp_path))


def test_only_a_bucket_is_asked_what_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a plain server has beyond its manifest nobody can know; asking it would take a while."""
    pytest.importorskip("aiohttp", reason="http needs the package aiohttp")
    asked: list[object] = []
    monkeypatch.setattr(RemoteStore, "_list_paths", asked.append)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    begin_tiny(tmp_path, 8)
    with serve(tmp_path) as site:
        assert missing_shards(site.url) == [0, 1]
    assert not asked


def test_rate_and_cost_are_those_of_the_logs(tmp_path: Path) -> None:
    """Two makers of 2 cores, 10 s a scene each: 720 scenes an hour, of two views each."""
    publication = begin_tiny(tmp_path, 12)
    folder = publication.folder
    for row in range(4):
        log_scene(folder, "train-000000.tar", row, seconds=10.0, cores=2, num_rejected=0)
    path = folder.logs / "train-000000.tar.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    ends = (1000.0, 1000.0, 1010.0, 1010.0)
    lines = [
        json.dumps({**row, "finished_unix_s": end}) for row, end in zip(rows, ends, strict=True)
    ]
    path.write_text("\n".join(lines) + '\n{"scene": "0000')
    found = read_status(str(tmp_path))
    assert found.views_per_hour == 4 / 20 * 3600 * 2
    assert found.remaining_s == 12 / (4 / 20)
    assert found.core_hours == 4 * 10 * 2 / 3600
    assert found.last_scene_unix_s == 1010.0


def test_of_many_logs_few_are_read_and_the_last_scenes_are_all_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each log has two scenes of 10 s on two cores, and a row that a kill has cut."""
    folder = DatasetFolder(tmp_path)
    assert sample_logs(folder) == ([], None)
    ends_s = [1000.0 + 7.0 * ((5 * number) % 24) for number in range(24)]  # in no order
    for number, end_s in enumerate(ends_s):
        path = folder.logs / f"part-{number // 8:04d}" / f"train-{number:06d}.tar.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = [{"seconds": 10.0, "cores": 2, "finished_unix_s": end_s + at} for at in (0.0, 5.0)]
        path.write_text("".join(f"{json.dumps(row)}\n" for row in rows) + '{"seconds": 1')
        os.utime(path, (end_s + 5.0, end_s + 5.0))
    (folder.logs / "asked.json").write_text("[]")
    every, core_s = sample_logs(folder)
    assert core_s == 24 * 2 * 10 * 2 and len(every) == 48
    decode = mock.Mock(wraps=progress.decode_scene_log)
    monkeypatch.setattr(progress, "decode_scene_log", decode)
    monkeypatch.setattr(progress, "LAST_SCENES", 5)
    monkeypatch.setattr(progress, "MOST_LOGS", 6)
    assert sample_logs(folder) == (every[-5:], core_s)
    assert decode.call_count == 5 + 6
