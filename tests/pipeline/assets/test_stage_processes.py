"""Several processes on one store, and processes that are killed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.pipeline.assets.child_kit import CALLS, Bench
from tests.pipeline.assets.meshes_by_hand import knot, sphere, write_obj

PROGRAM = """
import json, sys
from pathlib import Path
from pipeline.assets import stage
from pipeline.assets.settings import AssetSettings
from pipeline.assets.store import AssetStore
from tests.pipeline.assets import child_kit

def main():
    stage.attempt_in_child = child_kit.recorded_attempt
    root = Path(sys.argv[1])
    bench = child_kit.Bench(root)
    names = sorted(path.name for path in root.glob("*.obj"))
    prepared, failures = stage.prepare_assets(
        [bench.record(name) for name in names],
        AssetSettings(budgets=(500,)),
        AssetStore(root.parent / "store"),
        borrow_child=bench.borrow,
        workers=1,
        done=lambda: None,
    )
    bench.child.close()
    print(json.dumps({row.record.uid: row.asset_sha256 for row in prepared}))
    assert not failures, failures

if __name__ == "__main__":
    main()
"""


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """Five names for four objects, and a plan that says to work."""
    folder = tmp_path / "sources"
    Bench(folder)
    for number in range(3):
        write_obj(folder / f"knot{number}.obj", knot(segments=60 + 4 * number))
    write_obj(folder / "copy.obj", knot(segments=60))
    write_obj(folder / "ball.obj", sphere())
    return folder


def start(sources: Path) -> subprocess.Popen[str]:
    program = sources.parent / "program.py"
    program.write_text(PROGRAM)
    return subprocess.Popen(
        [sys.executable, str(program), str(sources)],
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


def calls(sources: Path) -> list[dict]:
    path = sources / CALLS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_two_processes_make_each_object_once(sources: Path) -> None:
    first, other = [finish(process) for process in [start(sources) for _ in range(2)]]
    assert len(first) == 5
    assert other == first
    assert first["copy.obj"] == first["knot0.obj"]
    assert len(set(first.values())) == 4
    assert len(calls(sources)) == 4


@pytest.mark.slow("kills")
def test_after_a_kill_the_next_run_makes_only_what_is_missing(sources: Path) -> None:
    """The second object never ends in the first run; its child dies with its owner."""
    plan = sources / "plan.json"
    plan.write_text(json.dumps({}))
    slow = sources / "knot1.obj"
    held = slow.read_bytes()
    slow.unlink()
    whole = finish(start(sources))
    slow.write_bytes(held)
    plan.write_text(json.dumps({"pymeshlab_collapse": "sleep"}))
    running = start(sources)
    while len(calls(sources)) < 4:
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.communicate()
    plan.write_text(json.dumps({}))
    after = finish(start(sources))
    assert {name: after[name] for name in whole} == whole
    assert set(after) == {*whole, "knot1.obj"}
    assert [call["name"] for call in calls(sources)[3:]] == ["knot1.obj", "knot1.obj"]


@pytest.mark.slow("kills")
def test_half_written_files_are_never_read(sources: Path) -> None:
    """A writer that was killed leaves a file with another ending beside the place of its own."""
    whole = finish(start(sources))
    store = sources.parent / "store"
    for path in store.rglob("*.safetensors"):
        data = path.read_bytes()
        path.with_name(f"{path.name}.99999.part").write_bytes(data[: len(data) // 2])
        path.unlink()
    assert finish(start(sources)) == whole
    assert len(calls(sources)) == 8
