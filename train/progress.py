"""What a run reports to its caller. `train` itself prints nothing."""

from collections.abc import Mapping


class TrainProgress:
    """Receives the events of a run: noted, then begin, then advance and validated in turns.

    Each does nothing here; a subclass shows those that it overrides.
    """

    def noted(self, text: str) -> None:
        """A warning for the user, such as one about the data."""

    def begin(
        self,
        *,
        step: int,
        num_steps: int,
        num_parameters: int,
        median_scores: Mapping[str, float] | None,
    ) -> None:
        """The run starts at `step`, above 0 when it resumes.

        The median picture is the baseline; None where there is no validation split.
        """

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        """`step` steps are done; `loss` is the mean over the views of the last one."""

    def validated(self, *, step: int, scores: Mapping[str, float]) -> None:
        """The validation split was judged after `step` steps (evaluation.scores)."""

    def hung(self, text: str) -> None:
        """A step does not end and the run was asked to stop then; called from another thread.

        Whoever runs it ends the process: nothing else ends a call that hangs. Here it goes on.
        """

    def interrupted(self, times: int) -> None:
        """A signal asks to stop, for the `times`-th time; called from another thread."""
