"""Child calls that fail on purpose, a record of the calls, and the stage that runs them.

`recorded_attempt` replaces `stage.attempt_in_child`. It runs in another process, so a file next to
the source holds its instructions, and it records its calls in another file.
"""

import ctypes
import dataclasses
import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.assets.attempt import AssetAttempt
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedObject, prepare_assets
from pipeline.assets.store import AssetStore
from pipeline.isolation import ChildLimits, IsolatedChild, preload
from storage.errors import Rejected, TrilightError
from storage.records.asset import Asset, decode_asset
from storage.records.objects import Failure, ObjectRecord

LIMITS = ChildLimits(memory_bytes=3 << 30, wall_s=60, cpu_s=20, calls_per_child=50)
CALLS = "calls.jsonl"
PLAN = "plan.json"


def nothing() -> None:
    """Set up nothing."""


def recorded_attempt(
    source: Path, settings: AssetSettings, method: str, root: Path | None = None
) -> AssetAttempt:
    """Write down who was called for what, then do what the plan beside the source says."""
    call = {"pid": os.getpid(), "name": source.name, "method": method, "budgets": settings.budgets}
    with (source.parent / CALLS).open("a") as stream:
        stream.write(json.dumps({**call, "epsilon": settings.epsilon}) + "\n")
    plan: dict[str, str] = json.loads((source.parent / PLAN).read_text())
    action, _, once = plan.get(method, "work").partition(" ")
    marker = source.parent / f"{method} {action}"
    if not (once and marker.exists()):
        marker.touch()
        _ACTIONS[action](source)
    from pipeline.assets.prepare import prepare_asset  # late: a child that dies pays for none of it

    attempt = prepare_asset(source, settings, method, root)
    missed = plan.get(f"{method} misses")
    return _without(attempt, int(missed)) if missed else attempt


def _without(attempt: AssetAttempt, below: int) -> AssetAttempt:
    """Leave out the levels below a budget, as if they had failed the gate."""
    kept = tuple(level for level in attempt.asset.levels if level.record.budget >= below)
    gone = {
        level.record.budget: ("silhouette_changed", "planned")
        for level in attempt.asset.levels
        if level.record.budget < below
    }
    asset = dataclasses.replace(attempt.asset, levels=kept)
    return dataclasses.replace(attempt, asset=asset, missed={**attempt.missed, **gone})


def burn(source: Path) -> None:
    while True:
        pass


def fail(source: Path) -> None:
    raise ZeroDivisionError


def refuse(source: Path) -> None:
    raise Rejected("degenerate", "planned")


def mistake(source: Path) -> None:
    raise TrilightError("planned mistake.")


_ACTIONS: Mapping[str, Callable[[Path], object]] = {
    "work": lambda source: None,
    "crash": lambda source: ctypes.string_at(0),
    "burn": burn,
    "sleep": lambda source: time.sleep(600),
    "eat": lambda source: bytearray(64 << 30),
    "die": lambda source: os.kill(os.getpid(), signal.SIGKILL),
    "leave": lambda source: os._exit(3),
    "fail": fail,
    "refuse": refuse,
    "vanish": Path.unlink,
    "grow": lambda source: source.write_text(source.read_text() + "# more\n"),
    "mistake": mistake,
}


@dataclass
class Bench:
    """A folder of sources with a plan, and children to work on them."""

    root: Path
    limits: ChildLimits = LIMITS

    def __post_init__(self) -> None:
        self.root.mkdir(parents=True, exist_ok=True)
        if not (self.root / PLAN).exists():
            self.set()
        heavy = ("pipeline.assets.prepare", "pipeline.assets.decimation.pymeshlab_filters")
        preload([*heavy, "tests.pipeline.assets.child_kit"])
        self.child = IsolatedChild(limits=self.limits)

    def set(self, **plan: str) -> None:
        """Say what children do: an action by method, such as `die` or `die once`."""
        (self.root / PLAN).write_text(json.dumps(plan))

    @contextmanager
    def borrow(self) -> Iterator[IsolatedChild]:
        yield self.child

    @property
    def calls(self) -> list[dict[str, Any]]:
        path = self.root / CALLS
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def record(self, name: str) -> ObjectRecord:
        from tests.pipeline.assets.meshes_by_hand import record_of

        return record_of(self.root / name, name)


FIRST, SECOND, THIRD = "pymeshlab_collapse", "meshoptimizer", "meshoptimizer_sloppy"
SETTINGS = AssetSettings(budgets=(1000, 500, 340))


def run(
    bench: Bench, *names: str, settings: AssetSettings = SETTINGS, store: str = "store"
) -> tuple[list[PreparedObject], list[Failure]]:
    """Prepare objects with a store beside the sources."""
    return prepare_assets(
        [bench.record(name) for name in names],
        settings,
        AssetStore(bench.root.parent / store),
        borrow_child=bench.borrow,
        workers=1,
        done=lambda: None,
    )


def made(bench: Bench, settings: AssetSettings = SETTINGS) -> Asset:
    (prepared,), failures = run(bench, "knot.obj", settings=settings)
    assert not failures
    return stored_asset(bench, prepared)


def stored_asset(bench: Bench, prepared: PreparedObject) -> Asset:
    store = AssetStore(bench.root.parent / "store")
    return decode_asset(store.asset_path(prepared.asset_name).read_bytes())


def methods(asset: Asset) -> list[tuple[int, str]]:
    return [(level.record.budget, level.record.method) for level in asset.levels]
