"""Notices a run whose pictures stay black.

An output that is pushed below 0 can lose its gradient for good: with the loss behind the ELU six of
nine small runs ended so. Ours is taken before it and none has, but a wrong setting can still do it,
and a night later is too late to hear of it.
"""

from collections import deque

from storage.errors import TrilightError
from train.loop.step import StepReport
from train.settings import TrainSettings

WATCHED_STEPS = 50
"""After the warm-up, so many steps are looked at, once."""

DEAD_BRIGHTNESS = 0.01
"""Pictures with less than this share of the targets' brightness are black in all but name. The L1
error does not tell: a fast start overshoots, and is then worse than black while it learns."""


class StartWatch:
    """Looks for light in the pictures of the first steps after the warm-up."""

    def __init__(self, settings: TrainSettings) -> None:
        self.due = settings.warmup_steps + WATCHED_STEPS
        self._reports: deque[StepReport] = deque(maxlen=WATCHED_STEPS)

    def add(self, report: StepReport) -> None:
        """Look at one step."""
        self._reports.append(report)

    def verdict(self, step: int) -> TrilightError | None:
        """Return what to say after `step` steps: nothing but at one step, and there if it learns.

        A run that is resumed after it is not judged again.
        """
        if step != self.due or len(self._reports) < WATCHED_STEPS:
            return None
        brightest = max(report.brightness for report in self._reports)
        if not brightest < DEAD_BRIGHTNESS:
            return None
        return TrilightError(
            f"training: the start went dead: after {step} steps the pictures are still black, with "
            f"at most {brightest:.2%} of the brightness of their targets. Start again with another "
            "seed or learning_rate; --resume goes on all the same."
        )
