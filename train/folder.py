"""Where things are in the folder of a run, and the claim of the trainer that writes them."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from storage.claims import claimed, describe_holder
from storage.errors import TrilightError

if TYPE_CHECKING:
    from train.loop.crew import Crew


@dataclass(frozen=True)
class RunFolder:
    """The paths of one run."""

    root: Path
    """The folder that users name."""

    @property
    def checkpoints(self) -> Path:
        """Folder of all that resuming needs (loop.checkpoints), one file per step."""
        return self.root / "checkpoints"

    @property
    def weights(self) -> Path:
        """The finished network alone (model.weights), as inference reads it."""
        return self.root / "model.safetensors"

    @property
    def settings(self) -> Path:
        """The settings in full, the dataset digest, and versions."""
        return self.root / "settings.json"

    @property
    def metrics(self) -> Path:
        """One JSON line per `log_every` steps, and one per validation."""
        return self.root / "metrics.jsonl"

    @property
    def sheet(self) -> Path:
        """Target, prediction and error of validation scenes."""
        return self.root / "validation_sheet.png"

    @property
    def tensorboard(self) -> Path:
        """What TensorBoard shows: the log's numbers as curves, and the sheets."""
        return self.root / "tensorboard"

    @property
    def notes(self) -> Path:
        """What happened and when: beginnings, resumes, warnings (watching.notes)."""
        return self.root / "notes.jsonl"

    @property
    def watching(self) -> Path:
        """Stacks of a step that hung, and traces of the profiler."""
        return self.root / "watching"

    @property
    def summary(self) -> Path:
        """The result as JSON."""
        return self.root / "summary.json"

    @property
    def claim(self) -> Path:
        """Lock of the trainer at work; absent while nobody trains, but after a kill."""
        return self.root / "train.claim"


@contextlib.contextmanager
def claim_run(folder: RunFolder, crew: "Crew") -> Iterator[None]:
    """Keep other trainers out of a run's folder for the block; all processes must call it.

    The first process holds the claim. A folder that is empty afterwards is as it was.

    Raises:
        TrilightError: another trainer has the folder, or it cannot be written.
    """
    new = [place for place in (folder.root, *folder.root.parents) if not place.exists()]
    problem: TrilightError | None = None
    with contextlib.ExitStack() as held:
        if crew.is_first:
            try:
                if not held.enter_context(claimed(folder.claim)):
                    problem = TrilightError(
                        f"{folder.root}: {describe_holder(folder.claim)}, trains there; expected a "
                        "folder for this trainer alone. Wait until it has ended, or choose another "
                        "--out."
                    )
            except TrilightError as error:
                problem = error
        if crew.any(problem is not None):
            raise problem or TrilightError(f"{folder.root}: the first process cannot train there.")
        try:
            yield
        finally:
            if crew.is_first:
                for remove in (folder.claim.unlink, *(place.rmdir for place in new)):
                    with contextlib.suppress(OSError):
                        remove()
