"""How a training run begins: anew, from another's weights, or from its own checkpoint."""

from dataclasses import dataclass

from storage.errors import TrilightError
from train.settings import TrainSettings

_HOW = "--set from_weights"


@dataclass(frozen=True, kw_only=True)
class Start:
    """How a run begins or goes on."""

    resume: bool = False
    """Go on from the folder's newest checkpoint; the weights come out the same to the bit on the
    CPU, for the same number of threads and processes. A finished run is judged again."""
    begin_with: str | None = None
    """Network whose weights and configuration a run with `from_weights` takes over."""
    lpips: str | None = None
    """Where LPIPS' weights are (train.loss.lpips.load_lpips)."""

    def check(self, settings: TrainSettings) -> None:
        """Refuse a start that is not the run's; one that goes on has begun and is not asked.

        Raises:
            TrilightError: the run begins with given weights and none are named, or the reverse.
        """
        if self.resume:
            return
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
