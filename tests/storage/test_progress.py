"""How far a dataset is, from its files alone."""

from pathlib import Path

from storage.layout import DatasetFolder
from storage.progress import (
    announce_downloads,
    announce_objects,
    count_object,
    read_progress,
)


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
