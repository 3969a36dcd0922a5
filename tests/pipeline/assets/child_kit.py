"""A bench of sources whose child calls do as a plan says, write themselves down, and may die.

`recorded_attempt` replaces `stage.attempt_in_child`. It runs in another process, so a file next to
the source holds its instructions, and it records its calls in another file. As a program, this
module prepares all sources of a folder and prints their digests.
"""

import ctypes
import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.assets import stage
from pipeline.assets.asset_store import AssetStore
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import AssetAttempt
from pipeline.isolation import ChildLimits, IsolatedChild, preload
from storage.errors import Rejected, TrilightError
from storage.records.asset import Asset, decode_asset
from storage.records.objects import Failure

LIMITS = ChildLimits(memory_bytes=3 << 30, wall_s=300, cpu_s=60, calls_per_child=50)
CALLS = "calls.jsonl"
PLAN = "plan.json"
FIRST, SECOND, THIRD = "pymeshlab_collapse", "meshoptimizer", "meshoptimizer_sloppy"
SETTINGS = AssetSettings(budgets=(1000, 500, 340))


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
    levels = attempt.asset.levels
    kept = tuple(level for level in levels if level.record.budget >= below)
    why = ("silhouette_changed", "planned")
    gone = {level.record.budget: why for level in levels if level not in kept}
    asset = dataclasses.replace(attempt.asset, levels=kept)
    return dataclasses.replace(attempt, asset=asset, missed={**attempt.missed, **gone})


def _burn(source: Path) -> None:
    while True:
        pass


def _raise(error: Exception) -> Callable[[Path], None]:
    def action(source: Path) -> None:
        raise error

    return action


_ACTIONS: Mapping[str, Callable[[Path], object]] = {
    "work": lambda source: None,
    "crash": lambda source: ctypes.string_at(0),
    "burn": _burn,
    "sleep": lambda source: time.sleep(600),
    "eat": lambda source: bytearray(64 << 30),
    "die": lambda source: os.kill(os.getpid(), signal.SIGKILL),
    "leave": lambda source: os._exit(3),
    "fail": _raise(ZeroDivisionError()),
    "refuse": _raise(Rejected("degenerate", "planned")),
    "vanish": Path.unlink,
    "grow": lambda source: source.write_text(source.read_text() + "# more\n"),
    "mistake": _raise(TrilightError("planned mistake.")),
}


@dataclass
class Bench:
    """A folder of sources with a plan, a store beside it, and a child to work on them."""

    root: Path

    def __post_init__(self) -> None:
        self.root.mkdir(parents=True, exist_ok=True)
        if not (self.root / PLAN).exists():
            self.set()
        heavy = ("pipeline.assets.prepare", "pipeline.assets.decimation.pymeshlab_filters")
        preload([*heavy, "tests.pipeline.assets.child_kit"])
        self.child = IsolatedChild(limits=LIMITS)

    def hurry(self, **limits: Any) -> None:
        """Work with a child of other limits from now on."""
        self.child.close()
        self.child = IsolatedChild(limits=dataclasses.replace(LIMITS, **limits))

    def set(self, **plan: str) -> None:
        """Say what children do: an action by method, such as `die` or `die once`."""
        (self.root / PLAN).write_text(json.dumps(plan))

    @property
    def calls(self) -> list[dict[str, Any]]:
        path = self.root / CALLS
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    @property
    def called(self) -> list[str]:
        return [call["method"] for call in self.calls]

    @property
    def num_children(self) -> int:
        return len({call["pid"] for call in self.calls})

    def run(
        self,
        *names: str,
        settings: AssetSettings = SETTINGS,
        store: str = "store",
        done: Callable[[], None] = lambda: None,
    ) -> tuple[list[stage.PreparedObject], list[Failure]]:
        """Prepare objects with a store beside the sources."""
        from tests.pipeline.assets.meshes_by_hand import record_of

        records = [record_of(self.root / name, name) for name in names]
        place = AssetStore(self.root.parent / store)
        return stage.prepare_assets(
            records,
            settings,
            place,
            borrow_child=lambda: nullcontext(self.child),
            workers=1,
            done=done,
        )

    def made(self, name: str = "knot.obj", settings: AssetSettings = SETTINGS) -> Asset:
        (prepared,), failures = self.run(name, settings=settings)
        assert not failures
        return self.stored(prepared)

    def stored(self, prepared: stage.PreparedObject) -> Asset:
        path = AssetStore(self.root.parent / "store").asset_path(prepared.asset_name)
        return decode_asset(path.read_bytes())


def methods(asset: Asset) -> list[tuple[int, str]]:
    return [(level.record.budget, level.record.method) for level in asset.levels]


def main() -> None:
    from tests.pipeline.assets import child_kit  # under the name by which children import it

    stage.attempt_in_child = child_kit.recorded_attempt
    bench = Bench(Path(sys.argv[1]))
    names = sorted(path.name for path in bench.root.glob("*.obj"))
    prepared, failures = bench.run(*names, settings=AssetSettings(budgets=(500,)))
    bench.child.close()
    sys.stdout.write(json.dumps({row.record.uid: row.asset_sha256 for row in prepared}))
    assert not failures, failures


if __name__ == "__main__":
    main()
