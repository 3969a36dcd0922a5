"""What an experiment declares: its points, what it measures of each, and how a table shows it.

No heavy library is imported here: the catalogue, the tests and the pages read declarations without
measuring anything.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from infra.bench.effort import Asked, Effort
from storage.errors import TrilightError

if TYPE_CHECKING:
    from infra.bench.workshop import Workshop

Figures = Mapping[str, float]
"""What one turn measures of one point, by name."""

TurnFigures = Iterable[tuple[str, Figures]]
"""The figures of every point in one turn, in order, by the name of the point."""

Over = Literal["median", "mean", "least", "most", "p5", "p95", "low", "high", "pair"]
"""How the figures of all turns become one number; `low` and `high` bound the mean: its 95 %
interval, bootstrapped over clusters of turns. `pair` is the mean of the differences to the run's
rival, turn by turn, and has its interval beside it."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column of the table: a figure of every turn, made one number."""

    name: str
    """Its heading, with the unit."""
    figure: str
    """Name of the figure among those that a turn returns."""
    over: Over = "median"
    """How the figures of all turns become one number."""
    then: Callable[[float], float] | None = None
    """Converts that number, for example `3600 / seconds`; None leaves it as it is."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """One setting that is measured."""

    name: str
    """What the table calls it."""
    settings: Any = None
    """What measuring it needs to know."""
    default: bool = False
    """Whether this is the product's default."""
    judged: bool = True
    """Whether the point is a choice; False for a yardstick, such as a picture's own noise."""


Measure = Callable[["Workshop", Sequence[Point], str], TurnFigures]
"""Measures all points in one turn. Raises `Rejected` or `ChildFailed` where the turn's scene or
object cannot be used: the turn then counts for no point."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Cost against error of the settings of one choice."""

    name: str
    """On the command line."""
    title: str
    """Heading of its section."""
    about: str
    """One sentence: what is measured, and on what."""
    cost: Column
    """The first column; above 0."""
    points: Callable[[Effort], Sequence[Point]]
    """The points, in the order of the table."""
    asked_points: Callable[[Asked], Sequence[Point]] = lambda asked: ()
    """Points of what the user asks for, before the others."""
    rival: Callable[[Asked], str] | None = None
    """Names the point that columns over `pair` take the others' differences to."""
    turns: Callable[[Effort], Sequence[str]]
    """Scenes, objects or repeats: in each turn every point is measured once."""
    measure: Measure = field(repr=False)
    """Measures a turn."""
    error: Column | None = None
    """The second column; None where only costs are compared."""
    better: Literal["higher", "lower"] = "lower"
    """Which direction is better: decibels are higher where pictures agree."""
    against: str = ""
    """What the error is measured to."""
    columns: tuple[Column, ...] = ()
    """Further columns."""
    also_cost: tuple[str, ...] = ()
    """Further columns that count as costs: a point cheaper in any of them is not dominated."""
    kind: Callable[[str], str] | None = None
    """Names what a point is one of. The figure then shows every cost as a series of its own, in
    its unit, and a colour for each kind; without it, cost ratios."""
    line_of: Callable[[Point], tuple[str, float]] | None = None
    """Names the line that a point stands on, and where on it. The figure then shows each further
    column along the lines, and no costs."""
    size_of: Callable[[Point], tuple[str, float]] | None = None
    """Names the line that a point stands on, and its size. The figure then shows every cost against
    the size, with the exponent of its growth."""
    against_size: str = ""
    """What the size is, where there is one."""
    because: str = ""
    """The default and its reason, or what the figures mean."""
    covers: tuple[str, ...] = ()
    """Dotted names of the settings that this is about: `build.` as in `--set` of generate, `order.`
    what a dataset order says, `train.` as in `--set` of train, `render.` an option."""
    cluster: Callable[[str], str] = str
    """Names what turns have in common whose figures are alike; by default nothing."""
    by_point: bool = False
    """Whether a point is measured without the others of its turn: a run that was interrupted then
    measures again only what is missing of a turn."""
    warm_up: bool = False
    """Whether one turn that is not counted comes first, where all turns are repeats."""
    takes_scenes: bool = False
    """Whether the scenes of the user's folder are turns as well."""
    needs: tuple[Literal["torch", "blender", "data", "moto"], ...] = ()
    """What the machine or the user has to provide."""


def points_of(experiment: Experiment, effort: Effort, asked: Asked) -> list[Point]:
    """Return all points of an experiment, in the order of the table.

    Raises:
        TrilightError: two have one name.
    """
    points = [*experiment.asked_points(asked), *experiment.points(effort)]
    names = [point.name for point in points]
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise TrilightError(
            f"bench {experiment.name}: {twice[0]!r} is there twice; expected each network once, in "
            "folders of different names."
        )
    return points


def percent(share: float) -> float:
    """Return a share in per cent, for `Column.then`."""
    return 100 * share


def one_by_one(measure: Callable[["Workshop", Point, str], Figures]) -> Measure:
    """Return a Measure that measures each point on its own, and adds `seconds` to its figures."""
    import time

    def turn_of(workshop: "Workshop", points: Sequence[Point], turn: str) -> TurnFigures:
        for point in points:
            began = time.perf_counter()
            found = measure(workshop, point, turn)
            yield point.name, {"seconds": time.perf_counter() - began, **found}

    return turn_of


def repeats(effort: Effort) -> tuple[str, ...]:
    """Return the turns of an experiment that repeats the same measurement."""
    return tuple(f"round {number}" for number in range(1, effort.repeats + 1))
