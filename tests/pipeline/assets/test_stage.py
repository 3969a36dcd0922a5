"""The stage: the next method where one fails, each object once; deaths change no data."""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from pipeline.assets import stage
from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.assets.stage import _drop_wasteful_levels, attempt_in_child, prepare_assets
from pipeline.assets.store import AssetStore
from pipeline.foreign.mesh import TriangleMesh
from pipeline.isolation import is_transient
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from tests.for_each import for_each
from tests.pipeline.assets.child_kit import (
    CALLS,
    FIRST,
    LIMITS,
    SECOND,
    SETTINGS,
    THIRD,
    Bench,
    made,
    methods,
    run,
)
from tests.pipeline.assets.meshes_by_hand import knot, write_obj


@pytest.fixture(autouse=True)
def source(bench: Bench) -> Path:
    """1440 faces: every level needs a method."""
    return write_obj(bench.root / "knot.obj", small_knot())


def small_knot() -> TriangleMesh:
    return knot(segments=60)


def test_the_next_method_starts_in_a_new_child_where_one_crashed(bench: Bench) -> None:
    bench.set(pymeshlab_collapse="crash")
    assert methods(made(bench)) == [(1000, SECOND), (500, SECOND), (340, SECOND)]
    assert [call["method"] for call in bench.calls] == [FIRST, FIRST, SECOND]
    assert len({call["pid"] for call in bench.calls}) == 3
    assert [call["budgets"] for call in bench.calls] == 3 * [[1000, 500, 340]]


def test_the_next_method_makes_only_what_the_first_one_missed_without_epsilon(bench: Bench) -> None:
    bench.set(**{f"{FIRST} misses": "900"})
    asset = made(bench)
    assert methods(asset) == [(1000, FIRST), (500, SECOND), (340, SECOND)]
    first, second = bench.calls
    assert second["budgets"] == [500, 340]
    assert first["pid"] != second["pid"]
    (bench.root / CALLS).unlink()
    # A second method that only fills in coarser levels must not search for the smallest.
    made(bench, AssetSettings(budgets=(1000, 240, 200), epsilon=0.005))
    finest, *others = (call["epsilon"] for call in bench.calls)
    assert finest == 0.005
    assert others and set(others) == {None}


def test_a_level_that_wastes_its_budget_is_left_out(source: Path) -> None:
    """Clusters at 1000 may come out coarser than the collapse at 500, which then serves both."""
    made = prepare_asset(source, SETTINGS, FIRST).asset.levels
    assert [len(level.faces) for level in made] == [1000, 500, 340]
    wasteful = dataclasses.replace(made[0], faces=made[0].faces[:450])
    for levels in ([wasteful, *made[1:]], [*made[1:], wasteful]):
        assert _drop_wasteful_levels(levels) == made[1:]
    assert _drop_wasteful_levels(list(made)) == made


def test_an_object_that_no_method_serves_is_refused_as_the_first_one_failed(
    bench: Bench, source: Path
) -> None:
    settings = AssetSettings(budgets=(240,), gate=GateSettings(max_error_p99=1e-4))
    messages = [prepare_asset(source, settings, name).missed[240][1] for name in (FIRST, SECOND)]
    assert messages[0] != messages[1]
    prepared, (failure,) = run(bench, "knot.obj", settings=settings)
    assert not prepared
    assert (failure.stage, failure.item) == ("assets", "knot.obj")
    assert (failure.reason, failure.message) == ("error_over_bound", messages[0])
    assert [call["method"] for call in bench.calls] == [FIRST, SECOND, THIRD]
    assert len({call["pid"] for call in bench.calls}) == 3


def test_a_method_that_stood_in_for_another_is_not_tried_twice(bench: Bench) -> None:
    """400 pages on one edge: pymeshlab would not end, so meshoptimizer takes its turn."""
    pages = np.arange(2, 402)
    faces = np.column_stack([np.zeros(400, np.int64), np.ones(400, np.int64), pages])
    positions = np.random.default_rng(0).random((402, 3))
    write_obj(bench.root / "book.obj", TriangleMesh(positions=positions, faces=faces))
    tight = AssetSettings(budgets=(240,), gate=GateSettings(max_error_p99=1e-4))
    _, (failure,) = run(bench, "book.obj", settings=tight)
    assert failure.reason == "error_over_bound"
    assert [call["method"] for call in bench.calls] == [FIRST, THIRD]


def test_an_unusable_object_is_tried_once_and_its_refusal_is_plain_text(bench: Bench) -> None:
    bench.set(pymeshlab_collapse="refuse")
    _, (failure,) = run(bench, "knot.obj")
    assert failure.reason == "degenerate"
    assert len(bench.calls) == 1
    (path,) = (bench.root.parent / "store").rglob("*.json")
    assert json.loads(path.read_text()) == {"reason": "degenerate", "message": "planned"}


def test_a_mistake_of_the_user_stops_the_run(bench: Bench) -> None:
    bench.set(pymeshlab_collapse="mistake")
    with pytest.raises(TrilightError, match="planned mistake"):
        run(bench, "knot.obj")


def test_the_second_run_makes_nothing_and_says_the_same(bench: Bench) -> None:
    (bench.root / "junk.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n")
    first = run(bench, "knot.obj", "junk.obj", "gone.obj")
    assert [failure.reason for failure in first[1]] == ["index_range", "missing_file"]
    calls = len(bench.calls)
    second = run(bench, "knot.obj", "junk.obj", "gone.obj")
    assert second == first
    assert len(bench.calls) == calls


def test_copies_are_made_once_and_keep_their_names(bench: Bench) -> None:
    write_obj(bench.root / "copy.obj", small_knot())
    prepared, _ = run(bench, "knot.obj", "copy.obj")
    assert [asset.record.uid for asset in prepared] == ["knot.obj", "copy.obj"]
    assert prepared[0].asset_name == prepared[1].asset_name
    assert len(bench.calls) == 1


def test_other_settings_are_another_outcome(bench: Bench) -> None:
    for budget in (500, 340):
        (level,) = made(bench, AssetSettings(budgets=(budget,))).levels
        assert len(level.faces) == budget
    assert len(bench.calls) == 2


def test_done_is_called_for_every_object(bench: Bench) -> None:
    count = iter(range(1, 100))
    last = [0]
    prepare_assets(
        [bench.record(name) for name in ("knot.obj", "gone.obj")],
        SETTINGS,
        AssetStore(bench.root.parent / "store"),
        borrow_child=bench.borrow,
        workers=2,
        done=lambda: last.append(next(count)),
    )
    assert last == [0, 1, 2]


def test_a_store_that_cannot_be_written_stops_the_run(bench: Bench) -> None:
    (bench.root.parent / "store").write_text("a file where the folder should be")
    with pytest.raises(TrilightError, match="cannot write"):
        run(bench, "knot.obj")
    assert not bench.calls


def test_a_file_that_the_system_will_not_open_is_refused_today_only(bench: Bench) -> None:
    loop = bench.root / "loop.obj"
    loop.symlink_to(loop)
    _, (failure,) = run(bench, "loop.obj")
    assert failure.reason == "unreadable_file"
    loop.unlink()
    write_obj(loop, small_knot())
    assert run(bench, "loop.obj")[1] == []


Hurried = Callable[..., Bench]


@pytest.fixture
def hurried(bench: Bench) -> Iterator[Hurried]:
    """The same bench with other limits."""
    with contextlib.ExitStack() as stack:

        def make(**limits: Any) -> Bench:
            other = Bench(bench.root, limits=dataclasses.replace(LIMITS, **limits))
            stack.callback(other.child.close)
            return other

        yield make


ENDS = [
    ("die", "killed", 3),
    ("eat", "out_of_memory", 3),
    ("leave", "crashed", 3),
    ("fail", "exception", 3),
    ("sleep", "timeout_wall", 2),
]
"""What children do, the reason, and how often the same is tried; none is a verdict on a mesh."""


@pytest.mark.parametrize(
    "actions",
    [("die", "eat", "leave", "fail", "crash"),
     pytest.param(("sleep",), marks=pytest.mark.slow("kills"))],
    ids=["deaths", "sleep"],
)  # fmt: skip
def test_a_child_that_dies_once_changes_no_byte(
    bench: Bench, hurried: Hurried, actions: tuple[str, ...]
) -> None:
    """A mesh of 1440 faces takes less than a second, and far below 15 on a busy machine."""
    bench = hurried(wall_s=15.0) if "sleep" in actions else bench
    (undisturbed,), _ = run(bench, "knot.obj", store="undisturbed")
    for times, action in enumerate(actions, start=1):
        bench.set(**{FIRST: f"{action} once"})
        (disturbed,), _ = run(bench, "knot.obj", store=action)
        assert [call["method"] for call in bench.calls] == [FIRST] * (1 + 2 * times), action
        assert disturbed.asset_sha256 == undisturbed.asset_sha256, action


@pytest.mark.parametrize(("action", "reason", "tries"), ENDS)
def test_what_the_environment_did_is_not_kept_and_leads_to_no_other_method(
    bench: Bench, hurried: Hurried, action: str, reason: str, tries: int
) -> None:
    bench.set(**{FIRST: action})
    prepared, (failure,) = run(hurried(wall_s=0.7) if action == "sleep" else bench, "knot.obj")
    assert (prepared, failure.reason) == ([], reason)
    assert is_transient(failure.reason)
    assert [call["method"] for call in bench.calls] == [FIRST] * tries
    assert len({call["pid"] for call in bench.calls}) == tries
    assert not [path for path in (bench.root.parent / "store").rglob("*.*") if path.is_file()]
    if action == "die":
        bench.set()
        assert methods(made(bench)) == [(1000, FIRST), (500, FIRST), (340, FIRST)]


def test_no_level_is_lost_because_its_child_died(bench: Bench) -> None:
    misses = {f"{FIRST} misses": "900"}
    bench.set(**misses)
    (undisturbed,), _ = run(bench, "knot.obj", store="undisturbed")
    bench.set(**misses, **{SECOND: "die"})
    prepared, (failure,) = run(bench, "knot.obj")
    assert (prepared, failure.reason) == ([], "killed")
    bench.set(**misses)
    (disturbed,), _ = run(bench, "knot.obj")
    assert disturbed.asset_sha256 == undisturbed.asset_sha256


@pytest.mark.parametrize(
    ("action", "reason", "tries"),
    [("crash", "crashed_signal_11", 2), ("burn", "timeout_cpu", 1), ("refuse", "degenerate", 1)],
)
def test_a_verdict_is_kept(
    bench: Bench,
    hurried: Hurried,
    action: str,
    reason: str,
    tries: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stage, "methods_of", lambda profile: (FIRST,))
    bench.set(**{FIRST: action})
    prepared, (failure,) = run(hurried(cpu_s=1), "knot.obj")
    assert (prepared, failure.reason) == ([], reason)
    assert not is_transient(failure.reason)
    assert len(bench.calls) == tries
    bench.set()
    assert run(bench, "knot.obj") == ([], [failure])
    assert len(bench.calls) == tries


@pytest.mark.parametrize("gone", [True, False])
def test_a_source_that_changes_meanwhile_is_judged_by_the_next_run(
    bench: Bench, source: Path, gone: bool
) -> None:
    """What a child found in another file is neither an asset nor a refusal of this one."""
    data = source.read_bytes()
    bench.set(**{FIRST: "vanish" if gone else "grow"})
    _, (failure,) = run(bench, "knot.obj")
    assert failure.reason == ("missing_file" if gone else "unreadable_file")
    bench.set()
    source.write_bytes(data)
    assert methods(made(bench)) == [(1000, FIRST), (500, FIRST), (340, FIRST)]


@for_each("error, kept", [(TrilightError("nan"), Rejected), (EnvironmentFailure("full"), None)])
def test_a_law_that_an_object_breaks_costs_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, kept: type[Exception] | None
) -> None:
    def broken(*_: object) -> NoReturn:
        raise error

    monkeypatch.setattr("pipeline.assets.prepare.prepare_asset", broken)
    with pytest.raises(kept or type(error)):
        attempt_in_child(tmp_path / "a.obj", AssetSettings(), "source")
