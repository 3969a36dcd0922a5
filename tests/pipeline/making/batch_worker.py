"""A process that freezes the objects of a dataset, and notes each object that it prepares.

python -m tests.pipeline.making.batch_worker OUT OBJECTS NOTES WORKERS [KILL_AFTER]
"""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from pipeline.making.pipeline import prepare_dataset
from storage.remote import claims
from tests.pipeline.making.batches_kit import use_mesher
from tests.pipeline.making.tiny_scenes_kit import tiny_order

BATCH = 8
LEASE_S = 10.0


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


if __name__ == "__main__":
    os.environ["TRILIGHT_VARIANT"] = "scalar_rgb"  # needs no probe
    claims.LEASE_S = LEASE_S
    out, objects, notes, *numbers = sys.argv[1:]
    prepare(out, Path(objects), Path(notes), *map(int, numbers))
