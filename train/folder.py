"""Paths in the folder of a run, its log and notes, and the lock of the trainer that writes them."""

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from storage.atomic import append_line, write_atomically
from storage.errors import TrilightError
from storage.file_locks import describe_holder, hold_lock
from storage.records.safe_read import read_plain
from storage.typed_json import read_json_lines

if TYPE_CHECKING:
    from train.loop.distributed import DistributedContext


class RunFolder:
    """Paths of the files of one run."""

    def __init__(self, root: Path) -> None:
        """Take the folder that the user names, such as by --out."""
        self.root = root
        self.checkpoints = root / "checkpoints"
        """Folder of the checkpoints, one file per saved step; model.open reads it."""
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
        """Dated notes: starts, resumes, warnings (`add_note`)."""
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


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a log, each with its `step`; a missing file has none.

    Raises:
        TrilightError: a line before the last is invalid; the last may be incomplete after a kill.
    """
    if not path.exists():
        return []
    rows = read_json_lines(read_plain(path), dict[str, Any], str(path), torn_end=True)
    for number, row in enumerate(rows, start=1):
        if not isinstance(row.get("step"), int):
            raise TrilightError(f"{path}:{number}: step is {row.get('step')!r}; expected a number.")
    return rows


def copy_rows(source: Path, path: Path, last_step: int) -> None:
    """Write the rows of a log up to a step, without a last line that a kill has cut."""
    rows = [row for row in read_rows(source) if row["step"] <= last_step]
    lines = [f"{json.dumps(row, sort_keys=True)}\n" for row in rows]
    write_atomically(path, "".join(lines).encode())


def add_note(path: Path, step: int, text: str) -> None:
    """Append a sentence without its full stop.

    Args:
        step: number of steps that were done by then.

    Raises:
        TrilightError: the folder is full or cannot be written.
    """
    line = json.dumps({"step": step, "at_unix_s": round(time.time()), "text": text})
    append_line(path, line)
