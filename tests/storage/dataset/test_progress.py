"""How far a dataset is, from its files alone."""

import os
from pathlib import Path

import pytest

from storage.dataset import progress
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, read_manifest
from storage.dataset.progress import (
    announce_downloads,
    announce_objects,
    count_object,
    forget_views,
    read_progress,
    tell_views,
)
from tests.pipeline.making.test_publication import begin_tiny, make_tiny_shard


def test_an_empty_folder_has_no_progress(tmp_path: Path) -> None:
    now = read_progress(DatasetFolder(tmp_path))
    assert (now.downloads_planned, now.objects_planned, now.scenes_planned) == (0, 0, 0)
    assert (now.downloads_done, now.objects_done, now.scenes_done) == (0, 0, 0)


def test_downloads_and_objects_are_counted(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    announce_downloads(folder, 2, 5)
    announce_objects(folder, 4)
    for _ in range(3):
        count_object(folder)
    now = read_progress(folder)
    assert (now.downloads_done, now.downloads_planned) == (2, 5)
    assert (now.objects_done, now.objects_planned) == (3, 4)


def test_a_new_run_counts_from_the_start(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    announce_objects(folder, 4)
    count_object(folder)
    announce_objects(folder, 7)
    now = read_progress(folder)
    assert (now.objects_done, now.objects_planned) == (0, 7)


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
    assert (now.scenes_done, now.scenes_planned, len(read)) == (4, 8, 2)


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
