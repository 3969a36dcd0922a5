"""A dataset that was begun and of which nothing was made binds nobody."""

import dataclasses
import re
from pathlib import Path

import pytest

from pipeline.builds.named import named_build
from pipeline.executors.threads import ThreadRunner
from pipeline.making.begin_publication import begin
from pipeline.making.bucket_publication import joined
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.pipeline import make_dataset, prepare_dataset
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.removed import removal_message
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import edit_manifest
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


@for_each("source", ["OBJECTZ", "empty", "builtin:many", "env:TRILIGHT_NOWHERE"])
def test_a_mistyped_source_leaves_nothing_behind(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(TrilightError, match="objects"):
        make_dataset(DatasetOrder(objects=source, out="set"), ThreadRunner())
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_what_was_only_begun_is_begun_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a run leaves it that ended over its objects: other settings and fewer scenes are free."""
    without_rendering(monkeypatch)
    folder = DatasetFolder(tmp_path / "set")
    with folder.joined():
        begin(folder, named_build("smoke", seed=5), {}, 24, accept_environment=False)
    run = prepare_dataset(tiny_order(out=str(folder.root), scenes=4, seed=7))
    assert run.publication.manifest.settings["seed"] == 7
    assert run.publication.manifest.num_scenes == 4


def test_what_has_objects_or_scenes_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_rendering(monkeypatch)
    order = tiny_order(out=str(tmp_path / "set"), scenes=4, seed=5)
    prepare_dataset(order)  # its objects are frozen, no more
    other = dataclasses.replace(order, seed=7)
    with pytest.raises(TrilightError, match="begun with another setting: seed was 5, now 7"):
        prepare_dataset(other)
    make_dataset(order, Undocumented())
    with pytest.raises(TrilightError, match="seed was 5, now 7"):
        prepare_dataset(other)


def test_nobody_forgets_while_another_is_at_work(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path / "set")
    with joined(folder):
        begin(folder, named_build("smoke", seed=5), {}, 4, accept_environment=False)
        with joined(folder):
            assert read_manifest(folder.manifest).settings["seed"] == 5


def test_who_was_replaced_all_the_same_stops(tmp_path: Path) -> None:
    """Locks do not reach every machine: a maker whose manifest has become another's says so."""
    folder = DatasetFolder(tmp_path / "set")
    with folder.joined():
        mine = begin(folder, named_build("smoke", seed=5), {}, 4, accept_environment=False)
        folder.manifest.unlink()
        begin(folder, named_build("smoke", seed=7), {}, 4, accept_environment=False)
        with pytest.raises(TrilightError, match="another dataset has been begun here"):
            mine.lock_objects([])


def test_a_dataset_of_removed_settings_is_read_and_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_rendering(monkeypatch)
    order = tiny_order(out=str(tmp_path / "set"), scenes=4)
    make_dataset(order, Undocumented())
    dataset = open_dataset(str(tmp_path / "set"))
    settings = dict(dataset.manifest.settings)
    settings["splits"] = {**settings["splits"], "object_parts": 2}
    edit_manifest(dataset, settings=settings)
    assert verify_dataset(str(tmp_path / "set")).problems == []
    refusal = re.escape(removal_message("setting 'splits.object_parts'"))
    with pytest.raises(TrilightError, match=refusal):
        make_dataset(order, Undocumented())
    with pytest.raises(TrilightError, match=refusal):
        named_build("smoke", changes={"splits.object_parts": 2})
