"""A knob, the curve that was measured of it, and which of its settings nobody should choose.

No heavy library is imported here: tests and the documentation read knobs without measuring them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from storage.errors import TrilightError

if TYPE_CHECKING:
    from infra.bench.trade.workshop import Workshop


@dataclass(frozen=True, kw_only=True)
class Point:
    """One setting of a knob."""

    setting: str
    """What the table calls it."""
    cost: float
    """In the knob's unit; above 0."""
    error: float | None
    """In the knob's unit; None where it cannot be known, and the knob says why."""
    default: bool = False
    """Whether this is what the product does when nobody says otherwise; one point of a curve is."""
    further: Mapping[str, float] = field(default_factory=dict)
    """Other figures of the same setting, by a name that holds their unit."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """What was measured of a knob."""

    points: tuple[Point, ...]
    """In the order of the table."""
    measured_on: str
    """Scenes, objects or arrays, and their size."""
    details: tuple[Mapping[str, float | str], ...] = ()
    """Scene by scene, where single scenes matter."""


@dataclass(frozen=True, kw_only=True)
class Knob:
    """One setting that trades cost for accuracy, or a few that are one choice."""

    name: str
    """On the command line."""
    title: str
    """Heading of its section."""
    covers: tuple[str, ...]
    """Dotted names of the settings that this curve is about, `build.` as in `--set` of generate,
    `order.` what a dataset order says, `train.` as in `--set` of train, `render.` an option;
    none where the choice is made in the code."""
    cost: str
    """Unit of the cost, in words."""
    error: str
    """Unit of the error, in words."""
    better: Literal["higher", "lower"]
    """Which way errors are good: dB are higher where pictures agree."""
    against: str
    """What the error is measured to."""
    because: str
    """The default and its reason, as the section ends."""
    measure: "Callable[[Workshop], Curve]" = field(repr=False, compare=False)
    """Measures it."""
    also_cost: tuple[str, ...] = ()
    """Further figures that count as costs too: a setting that is cheaper in any of them stays."""
    yardstick: str = ""
    """A row that is no setting, and shows what cannot be told apart: it is not judged."""
    needs: tuple[Literal["torch"], ...] = ()
    """Without these the knob is left out, with a line that says so."""


@dataclass(frozen=True, kw_only=True)
class JudgedPoint:
    """A setting beside the others."""

    point: Point
    """What was measured."""
    cost_ratio: float
    """Its cost by that of the default."""
    on_front: bool | None
    """Whether no other setting dominates it (`on_front`); None without an error, and for what is no
    setting."""


COST_NOISE = 0.03
"""Costs that differ by less than this share are equal: core-seconds of one run vary by as much."""


def on_front(figures: Sequence[tuple[float, Sequence[float]]]) -> list[bool]:
    """Return which of some points no other one dominates.

    One with less error dominates where none of its costs is more than COST_NOISE higher; one with
    the same error where none is higher and one is more than COST_NOISE lower. Some point always
    stays: whoever dominates has less error, or the same and less cost.

    Args:
        figures: error (smaller is better) and costs above 0 of each point, equally many.
    """
    return [not any(_dominates(other, mine) for other in figures) for mine in figures]


def _dominates(other: tuple[float, Sequence[float]], mine: tuple[float, Sequence[float]]) -> bool:
    costs = list(zip(other[1], mine[1], strict=True))
    if other[0] < mine[0]:
        return all(a <= (1 + COST_NOISE) * b for a, b in costs)
    lower = any((1 + COST_NOISE) * a < b for a, b in costs)
    return other[0] == mine[0] and lower and all(a <= b for a, b in costs)


def judged(knob: Knob, curve: Curve) -> list[JudgedPoint]:
    """Return the settings with their cost ratios and whether they are on the Pareto front.

    Raises:
        TrilightError: not exactly one point is the default.
    """
    base = default_point(knob, curve)
    known = [
        point
        for point in curve.points
        if point.error is not None and point.setting != knob.yardstick
    ]
    front = on_front([_figures(knob, point) for point in known])
    marks = {point.setting: mark for point, mark in zip(known, front, strict=True)}
    return [
        JudgedPoint(
            point=point,
            cost_ratio=point.cost / base.cost,
            on_front=marks.get(point.setting),
        )
        for point in curve.points
    ]


def default_point(knob: Knob, curve: Curve) -> Point:
    """Return the default of a curve; raises TrilightError unless exactly one point is."""
    defaults = [point for point in curve.points if point.default]
    if len(defaults) != 1:
        raise TrilightError(
            f"knob {knob.name}: {len(defaults)} of {len(curve.points)} settings are the default; "
            "expected exactly 1."
        )
    return defaults[0]


def _figures(knob: Knob, point: Point) -> tuple[float, list[float]]:
    """Return what a point is judged by: its error, smaller is better, and its costs."""
    assert point.error is not None
    error = -point.error if knob.better == "higher" else point.error
    return error, [point.cost, *(point.further[name] for name in knob.also_cost)]
