"""How a training run begins: anew, from another's weights or checkpoint, or from its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from storage.errors import TrilightError
from train.settings import TrainSettings

_HOW = "--set from_weights"


@dataclass(frozen=True, kw_only=True)
class Start:
    """How a run begins or goes on."""

    resume: bool = False
    """Go on from the folder's newest checkpoint; the weights come out the same to the bit on the
    CPU, for the same number of threads and processes. A finished run is judged again."""
    restartable: bool = False
    """Resume where the folder has a checkpoint, else begin: for whoever starts the same command
    again without looking."""
    branch: str | None = None
    """Checkpoint, or folder of a run, from which a new folder goes on: with its steps, its
    optimiser's memories and its place in the data. A run that resumes has branched and is not
    asked."""
    decisions: Mapping[str, Any] = field(default_factory=dict)
    """Settings by dotted name that change from the checkpoint on, and are recorded
    (train.going_on)."""
    begin_with: str | None = None
    """Network whose weights and configuration a run with `from_weights` takes over."""
    lpips: str | None = None
    """Where LPIPS' weights are (train.loss.lpips.load_lpips)."""

    @property
    def goes_on(self) -> bool:
        """Whether it begins with a checkpoint, and not with weights alone."""
        return self.resume or self.branch is not None

    def check(self, settings: TrainSettings) -> None:
        """Refuse a start that is not the run's; one that goes on has begun and is not asked.

        Raises:
            TrilightError: the run begins with given weights and none are named, or the reverse; a
                branch with them; decisions about a run that has not begun.
        """
        if self.branch is not None and self.begin_with is not None:
            raise TrilightError(
                f"run {settings.run}: branch is {self.branch} and begin_with is {self.begin_with}; "
                "expected one of them: the whole state of a run, or its weights alone."
            )
        if self.goes_on:
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
