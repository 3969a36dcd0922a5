"""The stage: the next method where one fails, each object once; deaths change no data."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NoReturn

import pytest

from pipeline.assets import stage
from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.assets.stage import _drop_wasteful_levels, attempt_in_child
from pipeline.isolation import is_transient
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.pipeline.assets import child_kit as kit
from tests.pipeline.assets.meshes_by_hand import book, knot, sphere, write_obj

ALL_FIRST = [(1000, kit.FIRST), (500, kit.FIRST), (340, kit.FIRST)]
TIGHT = AssetSettings(budgets=(240,), gate=GateSettings(max_error_p99=1e-4))


@pytest.fixture(autouse=True)
def source(bench: kit.Bench) -> Path:
    """1440 faces: every level needs a method."""
    return write_obj(bench.root / "knot.obj", knot(segments=60))


def test_the_next_method_starts_in_a_new_child_where_one_crashed(bench: kit.Bench) -> None:
    bench.set(pymeshlab_collapse="crash")
    assert kit.methods(bench.made()) == [(1000, kit.SECOND), (500, kit.SECOND), (340, kit.SECOND)]
    assert bench.called == [kit.FIRST, kit.FIRST, kit.SECOND]
    assert bench.num_children == 3
    assert [call["budgets"] for call in bench.calls] == 3 * [[1000, 500, 340]]


def test_the_next_method_makes_only_what_the_first_one_missed_without_epsilon(
    bench: kit.Bench,
) -> None:
    bench.set(**{f"{kit.FIRST} misses": "900"})
    assert kit.methods(bench.made()) == [(1000, kit.FIRST), (500, kit.SECOND), (340, kit.SECOND)]
    first, second = bench.calls
    assert second["budgets"] == [500, 340]
    assert first["pid"] != second["pid"]
    (bench.root / kit.CALLS).unlink()
    # A second method that only fills in coarser levels must not search for the smallest.
    bench.made(settings=AssetSettings(budgets=(1000, 240, 200), epsilon=0.005))
    finest, *others = (call["epsilon"] for call in bench.calls)
    assert finest == 0.005
    assert others and set(others) == {None}


def test_a_level_that_wastes_its_budget_is_left_out(source: Path) -> None:
    """Clusters at 1000 may come out coarser than the collapse at 500, which then serves both."""
    made = prepare_asset(source, kit.SETTINGS, kit.FIRST).asset.levels
    assert [len(level.faces) for level in made] == [1000, 500, 340]
    wasteful = dataclasses.replace(made[0], faces=made[0].faces[:450])
    for levels in ([wasteful, *made[1:]], [*made[1:], wasteful]):
        assert _drop_wasteful_levels(levels) == made[1:]
    assert _drop_wasteful_levels(list(made)) == made


def test_an_object_that_no_method_serves_is_refused_as_the_first_one_failed(
    bench: kit.Bench, source: Path
) -> None:
    attempts = [prepare_asset(source, TIGHT, name) for name in (kit.FIRST, kit.SECOND)]
    messages = [attempt.missed[240][1] for attempt in attempts]
    assert messages[0] != messages[1]
    prepared, (failure,) = bench.run("knot.obj", settings=TIGHT)
    assert not prepared
    assert (failure.stage, failure.item) == ("assets", "knot.obj")
    assert (failure.reason, failure.message) == ("error_over_bound", messages[0])
    assert bench.called == [kit.FIRST, kit.SECOND, kit.THIRD]
    assert bench.num_children == 3


def test_a_method_that_stood_in_for_another_is_not_tried_twice(bench: kit.Bench) -> None:
    """Pymeshlab would not end on this one, so meshoptimizer takes its turn."""
    write_obj(bench.root / "book.obj", book(400))
    _, (failure,) = bench.run("book.obj", settings=TIGHT)
    assert failure.reason == "error_over_bound"
    assert bench.called == [kit.FIRST, kit.THIRD]


def test_each_content_is_prepared_once_for_each_settings_and_reported_for_every_name(
    bench: kit.Bench, source: Path
) -> None:
    (bench.root / "copy.obj").write_bytes(source.read_bytes())
    (bench.root / "junk.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n")
    names = ("knot.obj", "copy.obj", "junk.obj", "gone.obj")
    done: list[None] = []
    prepared, failures = first = bench.run(*names, done=lambda: done.append(None))
    assert len(done) == 4
    assert [one.record.uid for one in prepared] == ["knot.obj", "copy.obj"]
    assert prepared[0].asset_name == prepared[1].asset_name
    assert [failure.reason for failure in failures] == ["index_range", "missing_file"]
    calls = len(bench.calls)
    assert bench.run(*names) == first
    assert len(bench.calls) == calls
    (level,) = bench.made(settings=AssetSettings(budgets=(340,))).levels
    assert len(level.faces) == 340
    assert len(bench.calls) == calls + 1


def test_mistakes_of_the_user_stop_the_run(bench: kit.Bench) -> None:
    bench.set(pymeshlab_collapse="mistake")
    with pytest.raises(TrilightError, match="planned mistake"):
        bench.run("knot.obj")
    (bench.root.parent / "file").write_text("a file where the folder should be")
    with pytest.raises(TrilightError, match="/file is a file; expected a folder"):
        bench.run("knot.obj", store="file")
    assert len(bench.calls) == 1


def test_a_file_that_the_system_will_not_open_is_refused_today_only(bench: kit.Bench) -> None:
    loop = bench.root / "loop.obj"
    loop.symlink_to(loop)
    _, (failure,) = bench.run("loop.obj")
    assert failure.reason == "unreadable_file"
    loop.unlink()
    write_obj(loop, knot(segments=60))
    assert bench.run("loop.obj")[1] == []


@pytest.mark.parametrize(
    "actions",
    [("die", "eat", "leave", "fail", "crash"),
     pytest.param(("sleep",), marks=pytest.mark.slow("kills"))],
    ids=["deaths", "sleep"],
)  # fmt: skip
def test_a_child_that_dies_once_changes_no_byte(bench: kit.Bench, actions: tuple[str, ...]) -> None:
    """A mesh of 1440 faces takes less than a second, and far below 15 on a busy machine."""
    if "sleep" in actions:
        bench.hurry(wall_s=15.0)
    (undisturbed,), _ = bench.run("knot.obj", store="undisturbed")
    for times, action in enumerate(actions, start=1):
        bench.set(**{kit.FIRST: f"{action} once"})
        (disturbed,), _ = bench.run("knot.obj", store=action)
        assert bench.called == [kit.FIRST] * (1 + 2 * times), action
        assert disturbed.asset_sha256 == undisturbed.asset_sha256, action


@pytest.mark.parametrize(
    ("action", "reason", "tries"),
    [
        ("die", "killed", 3),
        ("eat", "out_of_memory", 3),
        ("leave", "crashed", 3),
        ("fail", "exception", 3),
        ("sleep", "timeout_wall", 2),
    ],
)
def test_what_the_environment_did_is_not_kept_and_leads_to_no_other_method(
    bench: kit.Bench, action: str, reason: str, tries: int
) -> None:
    bench.set(**{kit.FIRST: action})
    if action == "sleep":
        bench.hurry(wall_s=2.0)
    prepared, (failure,) = bench.run("knot.obj")
    assert (prepared, failure.reason) == ([], reason)
    assert is_transient(failure.reason)
    assert bench.called == [kit.FIRST] * tries
    assert bench.num_children == tries
    assert not [path for path in (bench.root.parent / "store").rglob("*.*") if path.is_file()]
    if action == "die":
        bench.set()
        assert kit.methods(bench.made()) == ALL_FIRST


def test_no_level_is_lost_because_its_child_died(bench: kit.Bench) -> None:
    misses = {f"{kit.FIRST} misses": "900"}
    bench.set(**misses)
    (undisturbed,), _ = bench.run("knot.obj", store="undisturbed")
    bench.set(**misses, **{kit.SECOND: "die"})
    prepared, (failure,) = bench.run("knot.obj")
    assert (prepared, failure.reason) == ([], "killed")
    bench.set(**misses)
    (disturbed,), _ = bench.run("knot.obj")
    assert disturbed.asset_sha256 == undisturbed.asset_sha256


@pytest.mark.parametrize(
    ("action", "reason", "tries"),
    [("crash", "crashed_signal_11", 2), ("burn", "timeout_cpu", 1), ("refuse", "degenerate", 1)],
)
def test_a_verdict_is_kept_as_plain_text(
    bench: kit.Bench, action: str, reason: str, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if action != "refuse":  # an unusable object is refused whatever other methods there are
        monkeypatch.setattr(stage, "methods_of", lambda *profile, **watertight: (kit.FIRST,))
    bench.set(**{kit.FIRST: action})
    bench.hurry(cpu_s=1)
    prepared, (failure,) = bench.run("knot.obj")
    assert (prepared, failure.reason) == ([], reason)
    assert not is_transient(failure.reason)
    bench.set()
    assert bench.run("knot.obj") == ([], [failure])
    assert len(bench.calls) == tries
    (path,) = (bench.root.parent / "store").rglob("*.json")
    assert json.loads(path.read_text()) == {"reason": reason, "message": failure.message}


@pytest.mark.parametrize("gone", [True, False])
def test_a_source_that_changes_meanwhile_is_judged_by_the_next_run(
    bench: kit.Bench, source: Path, gone: bool
) -> None:
    """What a child found in another file is neither an asset nor a refusal of this one."""
    data = source.read_bytes()
    bench.set(**{kit.FIRST: "vanish" if gone else "grow"})
    _, (failure,) = bench.run("knot.obj")
    assert failure.reason == ("missing_file" if gone else "unreadable_file")
    bench.set()
    source.write_bytes(data)
    assert kit.methods(bench.made()) == ALL_FIRST


@for_each("error, kept", [(TrilightError("nan"), Rejected), (EnvironmentFailure("full"), None)])
def test_a_law_that_an_object_breaks_costs_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, kept: type[Exception] | None
) -> None:
    def broken(*_: object) -> NoReturn:
        raise error

    monkeypatch.setattr("pipeline.assets.prepare.prepare_asset", broken)
    with pytest.raises(kept or type(error)):
        attempt_in_child(tmp_path / "a.obj", AssetSettings(), "source")


@pytest.fixture
def sources(bench: kit.Bench, source: Path) -> kit.Bench:
    """Four names for three objects, and a plan that says to work."""
    (bench.root / "copy.obj").write_bytes(source.read_bytes())
    write_obj(bench.root / "other.obj", knot(segments=64))
    write_obj(bench.root / "ball.obj", sphere())
    return bench


def start(bench: kit.Bench) -> subprocess.Popen[str]:
    """Begin to prepare all sources of a bench in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.pipeline.assets.child_kit", str(bench.root)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> dict[str, str]:
    """Return the digests by name that a process ended with."""
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    digests: dict[str, str] = json.loads(output)
    return digests


def test_two_processes_make_each_object_once(sources: kit.Bench) -> None:
    first, other = [finish(process) for process in [start(sources) for _ in range(2)]]
    assert other == first
    assert first["copy.obj"] == first["knot.obj"]
    assert (len(first), len(set(first.values())), len(sources.calls)) == (4, 3, 3)


@pytest.mark.slow("kills")
def test_after_a_kill_the_next_run_makes_only_what_is_missing(sources: kit.Bench) -> None:
    """The last object never ends in the first run; its child dies with its owner."""
    late = sources.root / "other.obj"
    held = late.read_bytes()
    late.unlink()
    whole = finish(start(sources))
    late.write_bytes(held)
    sources.set(pymeshlab_collapse="sleep")
    running = start(sources)
    while len(sources.calls) < 3:
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.communicate()
    sources.set()
    assert finish(start(sources)).items() > whole.items()
    assert [call["name"] for call in sources.calls[2:]] == ["other.obj", "other.obj"]


@pytest.mark.slow("kills")
def test_half_written_files_are_never_read(sources: kit.Bench) -> None:
    """A writer that was killed leaves a file with another ending beside the place of its own."""
    whole = finish(start(sources))
    for path in (sources.root.parent / "store").rglob("*.safetensors"):
        data = path.read_bytes()
        path.with_name(f"{path.name}.99999.part").write_bytes(data[: len(data) // 2])
        path.unlink()
    assert finish(start(sources)) == whole
    assert len(sources.calls) == 6
