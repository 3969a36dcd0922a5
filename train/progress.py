"""What a run tells whoever started it, while it runs. `train` itself prints nothing."""

from collections.abc import Mapping
from typing import Protocol


class TrainProgress(Protocol):
    """Receives the course of a run: noted, then begin, then advance and validated, in turns."""

    def noted(self, text: str) -> None:
        """There is something about the data that the user should know."""

    def begin(
        self,
        *,
        step: int,
        num_steps: int,
        num_parameters: int,
        median_scores: Mapping[str, float] | None,
    ) -> None:
        """The run starts at `step`, above 0 when it resumes; the median picture is its rival.

        None where there is no validation split.
        """

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        """`step` steps are done; `loss` is the mean over the views of the last one."""

    def validated(self, *, step: int, scores: Mapping[str, float]) -> None:
        """The validation split was judged after `step` steps (evaluation.scores)."""

    def interrupted(self, times: int) -> None:
        """A signal asks to stop, for the `times`-th time; comes from a thread of its own."""


class Silent:
    """A Progress that says nothing."""

    def noted(self, text: str) -> None:
        """Ignore it."""

    def begin(
        self,
        *,
        step: int,
        num_steps: int,
        num_parameters: int,
        median_scores: Mapping[str, float] | None,
    ) -> None:
        """Ignore it."""

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        """Ignore it."""

    def validated(self, *, step: int, scores: Mapping[str, float]) -> None:
        """Ignore it."""

    def interrupted(self, times: int) -> None:
        """Ignore it."""
