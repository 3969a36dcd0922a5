"""The law of the closed loop: how often each stratum is drawn next, from what its scenes taught.

    score  = loss x learnability / cost
    weight = floor x base + (1 - floor) x (base x score, scaled to sum to one)

The loss alone would chase what nobody can learn: noise, and what the network is too small for.
Learnability is how far the loss of held-out scenes of the stratum fell in the last training. Where
nothing fell, scenes are drawn as the build draws them, and `floor` of them always are.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True)
class Lesson:
    """What the last round says of one stratum."""

    loss_before: float
    """Mean log L1 of its held-out views before the round's training."""
    loss: float
    """The same after it."""
    core_s: float
    """Core-seconds of making one of its scenes."""

    @property
    def learnability(self) -> float:
        """How far the loss fell; 0 where it rose."""
        return max(0.0, self.loss_before - self.loss)

    @property
    def score(self) -> float:
        """What a core-second there promises."""
        return self.loss * self.learnability / self.core_s


def next_weights(
    base: Mapping[str, float], lessons: Mapping[str, Lesson], floor: float
) -> dict[str, float]:
    """Return the share of the next scenes that each stratum gets; they sum to one.

    Args:
        base: how often the build draws each stratum, in proportion.
        lessons: by stratum; one without a lesson (no held-out scene) is taken for the mean.
        floor: share of the scenes that are drawn as the build draws them; 1 for all.

    Raises:
        TrilightError: a lesson is no number, or its cost is not above 0.
    """
    for name, lesson in lessons.items():
        if not (lesson.core_s > 0 and abs(lesson.score) < float("inf")):
            raise TrilightError(
                f"improve: stratum {name!r} has the lesson {lesson}; expected numbers."
            )
    total = sum(base.values())
    plain = {name: weight / total for name, weight in base.items()}
    known = sum(plain[name] for name in lessons)
    mean = (
        sum(plain[name] * lesson.score for name, lesson in lessons.items()) / known if known else 0
    )
    if mean == 0:
        return plain
    relative = {name: lessons[name].score / mean if name in lessons else 1.0 for name in plain}
    size = sum(plain[name] * relative[name] for name in plain)
    return {
        name: share * (floor + (1 - floor) * relative[name] / size) for name, share in plain.items()
    }
