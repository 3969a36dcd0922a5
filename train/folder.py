"""Where things are in the folder of a run."""

from dataclasses import dataclass
from pathlib import Path


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
