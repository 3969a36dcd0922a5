"""A child that dies changes no data: only what the object or the method is to blame for is kept."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.assets import stage
from pipeline.isolation import is_passing
from tests.pipeline.assets.child_kit import LIMITS, Bench
from tests.pipeline.assets.meshes_by_hand import knot, write_obj
from tests.pipeline.assets.stage_kit import FIRST, SECOND, made, methods, run

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


@pytest.fixture(autouse=True)
def source(bench: Bench) -> Path:
    """1440 faces: every level needs a method."""
    return write_obj(bench.root / "knot.obj", knot(segments=60))


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
    assert is_passing(failure.reason)
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
    assert not is_passing(failure.reason)
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
