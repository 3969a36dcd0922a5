"""Processes that may kill themselves at work.

python -m tests.pipeline.generation.killed_worker OUT OBJECTS NOTES WORKERS [KILL_AFTER] freezes the
objects of a dataset, and notes each object that it prepares.
python -m tests.pipeline.generation.killed_worker generate ... makes what `trilight generate` makes,
with scenes by hand.
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from infra.cli.app import main
from pipeline.generation.pipeline import prepare_dataset
from storage.remote import store
from tests.pipeline.generation.frozen_kit import use_mesher
from tests.pipeline.generation.tiny_scenes_kit import tiny_order, without_probe, without_rendering

BATCH = 8
LEASE_S = 10.0
KILL_AFTER_S = "TEST_KILL_AFTER_S"
"""Variable: so long after the first scene the process ends as by SIGKILL."""


def prepare(
    out: str, objects: Path, notes: Path, workers: int, kill_after: int = 1_000_000
) -> None:
    """Freeze the objects, preparing none before each of so many workers has a batch in hand."""
    mesher = use_mesher(pytest.MonkeyPatch(), batch=BATCH)
    ours = notes / str(os.getpid())

    def note(uid: str) -> None:
        ours.touch()
        while len(list(notes.iterdir())) < workers:
            time.sleep(0.01)
        if len(mesher.made) >= kill_after:
            os.kill(os.getpid(), signal.SIGKILL)
        with ours.open("a") as lines:
            lines.write(f"{uid}\n")
        time.sleep(0.02)  # as meshes take time, else one worker would have all

    mesher.before_each = note
    prepare_dataset(tiny_order(out=out, objects=str(objects), scenes=4))


def _made(scene: int) -> None:
    if (after := os.environ.pop(KILL_AFTER_S, None)) is not None:
        timer = threading.Timer(float(after), os.kill, (os.getpid(), signal.SIGKILL))
        timer.daemon = True
        timer.start()
    time.sleep(0.02)  # as pictures take time, else kills would find nobody at work


if __name__ == "__main__":
    if sys.argv[1] == "generate":
        patch = pytest.MonkeyPatch()
        without_rendering(patch, _made)
        patch.setattr("pipeline.documents.report.report_sections", lambda found: {})
        main()
    else:
        without_probe(pytest.MonkeyPatch())
        store.LEASE_S = LEASE_S
        out, objects, notes, *numbers = sys.argv[1:]
        prepare(out, Path(objects), Path(notes), *map(int, numbers))
