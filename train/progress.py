"""Progress events of a run for its caller. `train` itself prints nothing."""

from collections.abc import Mapping


class TrainProgress:
    """Callbacks of a run: notes, then begin, then advance and validations alternately.

    Each does nothing here; a subclass overrides those that it displays.
    """

    def note(self, text: str) -> None:
        """Receive a message for the user, such as a warning about the data."""

    def begin(
        self,
        *,
        step: int,
        num_steps: int,
        num_parameters: int,
        median_scores: Mapping[str, float] | None,
    ) -> None:
        """Receive the start of the run at `step`, which is above 0 when it resumes.

        `median_scores` are those of the baseline; None without a validation split.
        """

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        """Receive `step` finished steps; `loss` is the mean over the views of the last one."""

    def report_validation(self, *, step: int, scores: Mapping[str, float]) -> None:
        """Receive the scores of a validation after `step` steps (evaluation.metrics)."""

    def report_hang(self, text: str) -> None:
        """Receive a hang of a run that is to stop on one; called from another thread.

        The caller has to end the process, since nothing else ends a call that hangs.
        """

    def report_interrupt(self, times: int) -> None:
        """Receive the `times`-th signal to stop; called from another thread."""
