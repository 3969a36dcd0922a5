"""Paths in the folder of a run, and the lock of the trainer that writes them."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from storage.errors import TrilightError
from storage.file_locks import describe_holder, hold_lock

if TYPE_CHECKING:
    from train.loop.distributed import DistributedContext


class RunFolder:
    """Paths of the files of one run."""

    def __init__(self, root: Path) -> None:
        """Take the folder that the user names, such as by --out."""
        self.root = root
        self.checkpoints = root / "checkpoints"
        """Folder of the checkpoints, one file per saved step; model.checkpoint_format reads it."""
        self.weights = root / "model.safetensors"
        """Weights of the finished network (model.weights), as inference reads them."""
        self.settings = root / "settings.json"
        """The settings in full, the dataset digest, and versions."""
        self.metrics = root / "metrics.jsonl"
        """One JSON line per `log_every` steps, and one per validation."""
        self.sheet = root / "validation_sheet.png"
        """Target, prediction and error of validation scenes."""
        self.tensorboard = root / "tensorboard"
        """Folder of TensorBoard's files: the log's numbers and the sheets."""
        self.notes = root / "notes.jsonl"
        """Dated notes: starts, resumes, warnings (monitoring.rows)."""
        self.monitoring = root / "watching"
        """Folder of the stacks of hung steps, and of the profiler's traces."""
        self.summary = root / "summary.json"
        """The result as JSON."""
        self.claim = root / "train.claim"
        """Lock file of the running trainer; a killed trainer leaves it behind."""


@contextlib.contextmanager
def claim_run(folder: RunFolder, dist_context: "DistributedContext") -> Iterator[None]:
    """Lock a run's folder against other trainers for the block; all processes must call it.

    The first process holds the lock. Folders that are empty afterwards are removed again.

    Raises:
        TrilightError: another trainer has the folder, or it cannot be written.
    """
    new = [place for place in (folder.root, *folder.root.parents) if not place.exists()]
    problem: TrilightError | None = None
    with contextlib.ExitStack() as stack:
        if dist_context.is_first:
            try:
                if not stack.enter_context(hold_lock(folder.claim)):
                    problem = TrilightError(
                        f"{folder.root}: {describe_holder(folder.claim)}, trains there; expected a "
                        "folder for this trainer alone. Wait until it has ended, or choose another "
                        "--out."
                    )
            except TrilightError as error:
                problem = error
        if dist_context.any(problem is not None):
            raise problem or TrilightError(f"{folder.root}: the first process cannot train there.")
        try:
            yield
        finally:
            if dist_context.is_first:
                for remove in (folder.claim.unlink, *(place.rmdir for place in new)):
                    with contextlib.suppress(OSError):
                        remove()


def pretty_json(record: object) -> bytes:
    """Return indented, sorted JSON with a final newline."""
    return json.dumps(record, indent=1, sort_keys=True).encode() + b"\n"
