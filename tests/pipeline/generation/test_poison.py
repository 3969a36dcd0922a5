"""What kills a child, or takes the disk away, is a counted failure or a clear line.

All through the real `make_dataset`: meshes, children, renders, shards, documents.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors.threads import ThreadRunner
from pipeline.generation import pipeline
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome
from pipeline.generation.pipeline import make_dataset, prepare_dataset
from pipeline.generation.scene_worker import SceneWorker
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from storage.errors import EnvironmentFailure, TrilightError
from tests.pipeline.assets.meshes_by_hand import knot, write_obj
from tests.pipeline.generation import poison

pytestmark = pytest.mark.slow("kills")
"""Children that die and are started again take a minute together."""

SHARD_BYTES = 174_000
SHEET_BYTES = 150_000
"""The contact sheet of the first scene, about."""
"""Four scenes of four views at 32 pixels; measured."""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Objects, a cache that all runs of this file share, and one dataset that nothing disturbed."""
    folder = tmp_path_factory.mktemp("workshop")
    (folder / "objects").mkdir()
    for number in range(8):
        write_obj(folder / "objects" / f"knot{number}.obj", knot(segments=20 + number, sides=6))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRILIGHT_CACHE", str(folder / "cache"))
        patch.setattr("pipeline.documents.report.report_sections", lambda found: {})
        make(folder, folder / "plain")
        yield folder


def order(folder: Path, out: Path | str, **changes: object) -> GenerateOptions:
    return GenerateOptions(
        objects=str(folder / "objects"),
        out=str(out),
        **{"scenes": 8, "resolution": 32, "noise_floor_db": 20.0, **changes},  # type: ignore[arg-type]
    )


def make(folder: Path, out: Path | str, **changes: object) -> Outcome:
    return make_dataset(order(folder, out, **changes), ThreadRunner())


def expected(workshop: Path) -> str:
    return open_dataset(str(workshop / "plain")).digest


def prepare_by(monkeypatch: pytest.MonkeyPatch, attempt: Any) -> None:
    """Have children call this function of tests, which confined ones could not read."""
    monkeypatch.setattr("pipeline.assets.stage.attempt_in_child", attempt)
    monkeypatch.setenv("TRILIGHT_CONFINE", "off")


def test_a_mesh_that_crashes_its_child_is_one_failure(
    workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other objects are used, and the dataset is the one without it."""
    prepare_by(monkeypatch, poison.prepare_or_crash)
    poisoned = write_obj(workshop / "objects" / poison.OBJECT, knot(segments=64))
    try:
        outcome = make(workshop, tmp_path / "set")
    finally:
        poisoned.unlink()
    assert (outcome.num_objects_found, outcome.num_objects_used) == (9, 8)
    assert outcome.digest == expected(workshop)
    failures = open_dataset(str(tmp_path / "set")).failures()
    rejected = [(row.item, row.reason) for row in failures if row.stage == "assets"]
    assert rejected == [("poison", "crashed_signal_11")]


def test_an_object_whose_children_are_all_killed_is_tried_again_by_the_next_run(
    workshop: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A dataset begun without it says so; one that was begun with it waits for it."""
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    prepare_by(monkeypatch, poison.prepare_or_die)
    deaths, small = workshop / poison.DEATHS, {"scenes": 4}
    deaths.write_text("3")
    begun = prepare_dataset(order(workshop, tmp_path / "without", **small))
    assert begun.job.accepted.num_objects == 7
    (failure,) = open_dataset(str(tmp_path / "without")).failures()
    assert (failure.item, failure.reason) == ("knot0", "killed")
    (record,) = caplog.records
    assert "1 could not be prepared this time (1 x killed)" in record.getMessage()
    begun = prepare_dataset(order(workshop, tmp_path / "with", **small))
    assert begun.job.accepted.num_objects == 8
    shutil.rmtree(tmp_path / "cache")
    begun.publication.folder.staged_index.unlink()
    deaths.write_text("3")
    killed = "'knot0', which .* begun with.*killed.*run the same"
    with pytest.raises(EnvironmentFailure, match=killed):
        prepare_dataset(order(workshop, tmp_path / "with", **small))
    assert open_dataset(str(tmp_path / "with")).failures() == []
    again = prepare_dataset(order(workshop, tmp_path / "with", **small))
    assert again.job.accepted == begun.job.accepted


def test_meshes_that_are_away_are_made_again_where_a_scene_draws_them(
    workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of no scene are not, and one that has changed is refused."""
    begun = prepare_dataset(order(workshop, tmp_path / "set"))
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    prepare_by(monkeypatch, poison.prepare_or_die)
    (workshop / poison.DEATHS).write_text("1000")
    samples = open_dataset(str(workshop / "plain")).samples()
    drawn = {row.uid for sample in samples for row in sample.scene.objects}
    assert "knot0" in drawn
    assert prepare_dataset(order(workshop, tmp_path / "set")).job.accepted == begun.job.accepted
    with pytest.raises(EnvironmentFailure, match="'knot0', which .*killed.*run the same"):
        make(workshop, tmp_path / "set")
    mesh = workshop / "objects" / "knot0.obj"
    was = mesh.read_bytes()
    write_obj(mesh, knot(segments=40))
    (workshop / poison.DEATHS).write_text("0")
    with pytest.raises(TrilightError, match="'knot0' has changed; expected what"):
        make(workshop, tmp_path / "set")
    mesh.write_bytes(was)
    assert make(workshop, tmp_path / "set").digest == expected(workshop)
    assert len(list((tmp_path / "cache").glob("assets/??/*.safetensors"))) <= len(drawn) + 1


def test_scenes_that_abort_their_child_are_counted(
    workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is saved by its next attempt; one is given up, within the budget and beyond it."""
    monkeypatch.setattr(SceneWorker, "attempt", poison.render_or_abort)
    monkeypatch.setattr(pipeline, "MAX_ATTEMPTS", 2)  # 16 would start a child 48 times
    with pytest.raises(TrilightError, match="1 of 8 scenes could not be made.*budget of 0%"):
        make(workshop, tmp_path / "set", failure_budget=0.0)
    outcome = make(workshop, tmp_path / "set", failure_budget=0.2)
    assert outcome.num_scenes_given_up == 1
    dataset = open_dataset(str(tmp_path / "set"))
    assert verify_dataset(tmp_path / "set").problems == []
    keys = [key for shard in dataset.manifest.shards for key in dataset.keys(shard)]
    assert keys == [f"{index:09d}" for index in range(8) if index != poison.LOST_SCENE]
    skips = [row for row in dataset.failures() if row.reason == "environmental_skip"]
    assert [(int(row.item), row.attempt) for row in skips] == [(1, 0), (2, 0), (2, 1)]
    assert all("SIGABRT" in row.message for row in skips)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 8 MB, which only root can make."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a small disk must be mounted, which takes root and the right to mount")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_is_one_line_and_loses_nothing(workshop: Path, small_disk: Path) -> None:
    """Room for nothing; for the first scenes; for all scenes of a shard, and not for the shard."""
    out, ballast = small_disk / "set", small_disk / "ballast"
    for room in (20_000, SHARD_BYTES // 2, SHARD_BYTES + SHARD_BYTES // 2 + SHEET_BYTES):
        ballast.unlink(missing_ok=True)
        used = sum(path.stat().st_size for path in small_disk.rglob("*") if path.is_file())
        free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
        ballast.write_bytes(bytes(free - max(4096, room - used)))
        with pytest.raises(EnvironmentFailure, match="the disk is full.*free some space") as caught:
            make(workshop, out)
        assert "\n" not in str(caught.value)
        assert not list(out.glob("*.tar"))
        assert not list(out.rglob("*.part"))
        if (out / "manifest.json").exists():
            assert verify_dataset(out).problems == []
    assert len(list(out.glob(".staging/samples/*/*.tar"))) == 4
    ballast.unlink()
    assert make(workshop, out).digest == expected(workshop)
    assert verify_dataset(out).problems == []
