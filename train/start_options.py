"""Options of how a run starts: new, from weights, from a branch, or resumed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from storage.errors import TrilightError
from train.settings import TrainSettings

_HOW = "--set from_weights"


@dataclass(frozen=True, kw_only=True)
class StartOptions:
    """Options of how a run starts or resumes."""

    resume: bool = False
    """Resume from the folder's newest checkpoint. On the CPU, with the same number of threads and
    processes, the weights are exactly those of an uninterrupted run. A finished run is judged
    again."""
    restartable: bool = False
    """Resume if the folder has a checkpoint, else start: one command serves every restart."""
    branch: str | None = None
    """Checkpoint or run folder whose state a new folder continues: steps, optimizer state and
    position in the data. A run that resumes has branched already and ignores it."""
    decisions: Mapping[str, Any] = field(default_factory=dict)
    """Settings by dotted name that change from the checkpoint on; the run records them."""
    begin_with: str | None = None
    """Path or name of the network whose weights a run with `from_weights` starts with."""
    lpips: str | None = None
    """Source of the LPIPS weights (train.loss.lpips.load_lpips)."""

    @property
    def continues_run(self) -> bool:
        """True if the run starts from a checkpoint, not from weights alone."""
        return self.resume or self.branch is not None

    def check(self, settings: TrainSettings) -> None:
        """Raise if these options contradict the run's settings; a resumed run is not checked.

        Raises:
            TrilightError: `from_weights` and `begin_with` disagree; both a branch and weights are
                given; or settings are changed of a run that has not started.
        """
        if self.branch is not None and self.begin_with is not None:
            raise TrilightError(
                f"run {settings.run}: branch is {self.branch} and begin_with is {self.begin_with}; "
                "expected one of them: the whole state of a run, or its weights alone."
            )
        if self.continues_run:
            return
        if self.decisions and not self.restartable:
            name = next(iter(self.decisions))
            raise TrilightError(
                f"run {settings.run}: it has not begun, so --change {name} changes nothing; "
                "expected --set, or --resume or --branch to go on with a run."
            )
        if settings.from_weights and self.begin_with is None:
            raise TrilightError(
                f"run {settings.run}: begins with trained weights, and none are named; expected "
                f"begin_with, or {_HOW}=false to begin with random weights."
            )
        if self.begin_with is not None and not settings.from_weights:
            raise TrilightError(
                f"run {settings.run}: begins with random weights, but begin_with is "
                f"{self.begin_with}; expected none, or {_HOW}=true to begin with those."
            )
