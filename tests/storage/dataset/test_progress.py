"""How far a dataset is, from its files alone: counts, the rate of the last scenes, cut rows."""

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.dataset import progress, scene_logs
from storage.dataset.asked import write_asked
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, read_manifest, write_manifest
from storage.dataset.progress import (
    announce_downloads,
    announce_objects,
    count_object,
    forget_views,
    read_progress,
    read_status,
    tell_views,
    unfinished_shards,
)
from storage.dataset.scene_logs import SceneLog, log_scene, sample_logs
from storage.dataset.shard_notes import note_of
from storage.errors import TrilightError
from tests.http_server import serve
from tests.pipeline.generation.test_dataset_writer import begin_tiny, make_tiny_shard


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
    read, publication = list[Path](), begin_tiny(tmp_path, 8)

    def counted(path: Path) -> Manifest:
        read.append(path)
        return read_manifest(path)

    monkeypatch.setattr(progress, "read_manifest", counted)
    for _ in range(3):
        assert read_progress(publication.folder).scenes_planned == 8
    assert len(read) == 1
    make_tiny_shard(publication, 0)
    now = read_progress(publication.folder)
    assert (now.scenes_done, now.scenes_planned, len(read)) == (4, 8, 1)
    begin_tiny(tmp_path, 12)
    assert (read_progress(publication.folder).scenes_planned, len(read)) == (12, 2)


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
    forget_views(folder, 3)
    forget_views(folder, 3)  # whoever comes second
    assert read_progress(folder).views_done == 4 * 2 + 1.5
    (left,) = (folder.staging / "at_work").iterdir()
    os.utime(left, (0, 0))
    assert read_progress(folder).views_done == 4 * 2


def test_where_nothing_can_be_written_nothing_is_told(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    (tmp_path / ".staging").write_text("in the way")
    tell_views(folder, 0, 0.5)
    forget_views(folder, 0)


def test_shards_scenes_and_what_to_do_next(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path, 12)
    make_tiny_shard(publication, 1)
    found = read_status(str(tmp_path))
    assert found.views_per_hour is None
    assert (found.shards_done, found.shards_planned) == (1, 3)
    assert (found.scenes_done, found.scenes_planned) == (4, 12)
    assert not found.finished
    assert found.next_words is None  # nobody wrote down how it was begun
    write_asked(publication.folder, ["generate", "smoke", "--scenes", "12"])
    begun = ("generate", "smoke", "--scenes", "12", "--out", str(tmp_path))
    assert read_status(str(tmp_path)).next_words == begun
    assert found.failures == [("scenes", "no_camera", 4)]
    # a shard without its note, as a kill leaves it
    note_of(publication.folder, "train-000001.tar").unlink()
    assert read_status(str(tmp_path)).shards_done == 1


def test_only_a_bucket_is_asked_what_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a plain server has beyond its manifest nobody can know; asking it would take a while."""
    pytest.importorskip("aiohttp", reason="http needs the package aiohttp")
    asked: list[object] = []
    monkeypatch.setattr(progress, "BucketStore", asked.append)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    begin_tiny(tmp_path, 8)
    with serve(tmp_path) as site:
        assert unfinished_shards(site.url) == [0, 1]
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


def test_a_manifest_that_does_not_say_how_it_is_divided_is_a_mistake_in_words(
    tmp_path: Path,
) -> None:
    path = begin_tiny(tmp_path, 4).folder.manifest
    manifest = read_manifest(path)
    for splits in ({}, {"splits": {"shards": 3}}, {"splits": 3}):
        settings = {k: v for k, v in manifest.settings.items() if k != "splits"} | splits
        write_manifest(path, dataclasses.replace(manifest, settings=settings))
        with pytest.raises(TrilightError):
            read_status(str(tmp_path))


def _write_log(folder: DatasetFolder, number: int, *, end_s: float) -> None:
    """Write a log of two scenes of 10 s on two cores, and of a row that a kill has cut."""
    path = folder.logs / f"part-{number // 8:04d}" / f"train-{number:06d}.tar.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [{"seconds": 10.0, "cores": 2, "finished_unix_s": end_s + at} for at in (0.0, 5.0)]
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows) + '{"seconds": 1')
    os.utime(path, (end_s + 5.0, end_s + 5.0))


def test_of_many_logs_few_are_read_and_the_last_scenes_are_all_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = DatasetFolder(tmp_path)
    assert sample_logs(folder).core_s is None
    ends_s = [1000.0 + 7.0 * ((5 * number) % 24) for number in range(24)]  # in no order
    for number, end_s in enumerate(ends_s):
        _write_log(folder, number, end_s=end_s)
    (folder.logs / "asked.json").write_text("[]")
    every = sample_logs(folder)
    assert every.core_s == 24 * 2 * 10 * 2 and len(every.last) == 48
    read, decode = Counter[str](), scene_logs.decode_scene_log

    def counted(text: str) -> Iterator[SceneLog]:
        read["logs"] += 1
        return decode(text)

    monkeypatch.setattr(scene_logs, "decode_scene_log", counted)
    monkeypatch.setattr(scene_logs, "LAST_SCENES", 5)
    monkeypatch.setattr(scene_logs, "MOST_LOGS", 6)
    some = sample_logs(folder)
    assert read["logs"] == 5 + 6 and some.core_s == every.core_s
    assert some.last == every.last[-5:]
