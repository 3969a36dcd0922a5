"""How far a dataset is: counts of files, the rate of the last scenes, rows cut by a kill."""

import dataclasses
import json
from pathlib import Path

from storage.dataset.asked import write_asked
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest, write_manifest
from storage.dataset.scene_log import log_scene, read_scene_logs
from storage.dataset.status import read_status
from tests.pipeline.making.test_publication import begin_tiny, make_tiny_shard


def test_shards_scenes_and_what_to_do_next(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path, 12)
    make_tiny_shard(publication, 1)
    found = read_status(str(tmp_path))
    assert (found.shards_done, found.shards_planned) == (1, 3)
    assert (found.scenes_done, found.scenes_planned) == (4, 12)
    assert not found.finished
    assert found.next_words is None  # nobody wrote down how it was begun
    write_asked(publication.folder, ["generate", "smoke", "--scenes", "12"])
    begun = ("generate", "smoke", "--scenes", "12", "--out", str(tmp_path))
    assert read_status(str(tmp_path)).next_words == begun
    assert found.failures == [("scenes", "no_camera", 4)]
    # a shard that the manifest does not list yet, as a range of another process leaves it
    manifest = read_manifest(publication.folder.manifest)
    write_manifest(publication.folder.manifest, dataclasses.replace(manifest, shards=()))
    assert read_status(str(tmp_path)).shards_done == 1


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


def test_logs_without_rows_say_nothing(tmp_path: Path) -> None:
    begin_tiny(tmp_path, 4)
    assert list(read_scene_logs(DatasetFolder(tmp_path))) == []
    assert read_status(str(tmp_path)).views_per_hour is None
