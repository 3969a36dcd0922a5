"""`RecordedSampler`: random numbers that are drawn by name from a stated range, and remembered.

What a surface or a sky is drawn from is written once, where it is drawn. The tests compare what was
drawn with what was stated, and the reference page of surfaces and skies is made of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import cosine, lerp, sine

Kind = Literal["uniform", "whole number", "share", "colour", "shade", "direction", "choice"]


@dataclass(frozen=True, kw_only=True)
class RecordedDraw:
    """Stated distribution of one name, and the drawn values."""

    kind: Kind
    """Distribution: uniform in a range; uniform whole numbers; true with a probability; a color
    with independent uniform channels; a uniform place on the line between two colors; a direction
    uniform by solid angle; or equally likely words."""
    stated: Any
    """Lowest and highest value; a probability; the two colors; the lowest and highest elevation in
    degrees; or the words."""
    values: list[Any] = field(default_factory=list)
    """Drawn values in order: one number, or one for each such thing of the sky or surface; a shade
    holds its position between the two colors."""

    def __str__(self) -> str:
        """Return the distribution as the end of a sentence."""
        if self.kind == "share":
            return f"true with probability {self.stated:g}"
        if self.kind == "choice":
            return f"one of {', '.join(self.stated)}, equally likely"
        low, high = self.stated
        if self.kind in ("colour", "shade"):
            one, other = (f"({' '.join(f'{c:g}' for c in end)})" for end in (low, high))
            shape = "each channel uniform" if self.kind == "colour" else "uniform on the line"
            return f"{shape} from {one} to {other}"
        if self.kind == "direction":
            return f"uniform by solid angle, elevation {low:g} to {high:g} degrees"
        return f"{self.kind}, {low:g} to {high:g}"


class RecordedSampler:
    """Draws from one generator, with + - * / and square roots only (scene_templates.exact)."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Draw from `rng`, which no other code may use at the same time."""
        self._rng = rng
        self.made: dict[str, RecordedDraw] = {}

    def uniform(self, name: str, low: float, high: float) -> float:
        """Return a number uniform in [low, high]."""
        return self._record(name, "uniform", (low, high), self._between(low, high))

    def whole(self, name: str, low: int, high: int) -> int:
        """Return a whole number; each from `low` to `high` is equally likely."""
        drawn = int(self._rng.integers(low, high + 1))
        return self._record(name, "whole number", (low, high), drawn)

    def holds(self, name: str, share: float) -> bool:
        """Return whether something holds, which it does with a probability of `share`."""
        return self._record(name, "share", share, bool(self._rng.random() < share))

    def choice(self, name: str, words: Sequence[str]) -> str:
        """Return one of the words, each equally likely."""
        drawn = words[int(self._rng.integers(len(words)))]
        return self._record(name, "choice", tuple(words), drawn)

    def colour(self, name: str, low: Sequence[float], high: Sequence[float]) -> NDArray[np.float64]:
        """Return a colour [3] whose channels are independent and uniform in their ranges."""
        drawn = np.array([self._between(*ends) for ends in zip(low, high, strict=True)])
        return self._record(name, "colour", (tuple(low), tuple(high)), drawn)

    def shade(self, name: str, one: Sequence[float], other: Sequence[float]) -> NDArray[np.float64]:
        """Return a colour [3] on the straight line between two, uniform along it."""
        share = self._record(name, "shade", (tuple(one), tuple(other)), self._between(0, 1))
        return lerp(one, other, share)

    def direction(self, name: str, low_deg: float, high_deg: float) -> NDArray[np.float64]:
        """Return a unit vector [3] between two elevations, uniform by solid angle; +Z is up."""
        ends = sine(np.array([low_deg, high_deg]) / 180 * np.pi)
        z = self._between(float(ends[0]), float(ends[1]))
        azimuth = self._between(-np.pi, np.pi)
        across = np.sqrt(max(0.0, 1 - z * z))
        drawn = np.array([across * float(cosine(azimuth)), across * float(sine(azimuth)), z])
        return self._record(name, "direction", (low_deg, high_deg), drawn)

    def stream(self) -> np.random.Generator:
        """Return a generator of its own for a noise or the parts of a pattern.

        However much is taken of it, what is drawn after it stays.
        """
        return np.random.default_rng(int(self._rng.integers(2**63)))

    def _between(self, low: float, high: float) -> float:
        # not rng.uniform, whose product and sum some compilers fuse and so round once less
        return float(low + (high - low) * self._rng.random())

    def _record(self, name: str, kind: Kind, stated: Any, value: Any) -> Any:
        draw = self.made.setdefault(name, RecordedDraw(kind=kind, stated=stated))
        if (draw.kind, draw.stated) != (kind, stated):
            raise ValueError(f"{name!r} is drawn from {stated} and from {draw.stated}")
        draw.values.append(value)
        return value
