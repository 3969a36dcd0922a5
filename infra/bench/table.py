"""The one table of an experiment, for the terminal and for pages."""

from collections.abc import Iterator, Sequence

from infra.bench.curve import Row, columns_of, rows
from infra.bench.experiment import Column, Experiment
from infra.bench.store import Run


def shown(value: float) -> str:
    """Return a number with three digits or a little more, without powers of ten where it can."""
    size = abs(value)
    if value == 0 or size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def shown_in(column: Column, row: Row) -> str:
    """Return one cell: decibels with one digit behind the point, n/a for what is not known.

    A mean difference has its 95 % interval behind it.
    """
    value = row.values.get(column.name)
    if value is None:
        return "" if column.over == "pair" else "n/a"
    if column.name in row.intervals:
        low, high = row.intervals[column.name]
        return f"{value:+.1f} ({low:.1f} to {high:.1f})"
    return f"{value:.1f}" if "dB" in column.name else shown(value)


def front_word(row: Row) -> str:
    """Return whether a point is on the front, in a word."""
    return {True: "yes", False: "no", None: "n/a"}[row.on_front]


def headings(experiment: Experiment, points: Sequence[Row]) -> list[str]:
    """Return the heading of every column; costs are divided by the default's where there is one."""
    cost, *others = (column.name for column in columns_of(experiment))
    ratio = ["ratio"] if _has_default(points) else []
    front = ["front"] if experiment.error else []
    return ["setting", cost, *ratio, *others, *front]


def cells(experiment: Experiment, row: Row, points: Sequence[Row]) -> list[str]:
    """Return the cells of one point of a table."""
    cost, *others = columns_of(experiment)
    ratio = [f"{shown(row.cost_ratio)} x"] if _has_default(points) else []
    further = [shown_in(column, row) for column in others]
    front = [front_word(row)] if experiment.error else []
    return [row.point.name, shown_in(cost, row), *ratio, *further, *front]


def printed(experiment: Experiment, run: Run) -> Iterator[list[str]]:
    """Yield the headings, and the cells of every point with smallest and largest of its cost."""
    points = rows(experiment, run)
    yield headings(experiment, points)
    for row in points:
        name, cost, *rest = cells(experiment, row, points)
        if row.cost_spread:
            cost += f" ({shown(row.cost_spread.low)} to {shown(row.cost_spread.high)})"
        yield [f"{name}{' *' if row.point.default else ''}", cost, *rest]


def markdown(experiment: Experiment, run: Run) -> Iterator[str]:
    """Yield the table as lines of Markdown, the default in bold."""
    points = rows(experiment, run)
    names = headings(experiment, points)
    yield f"| {' | '.join(names)} |"
    yield f"|{'---|' * len(names)}"
    for row in points:
        name, *rest = cells(experiment, row, points)
        yield f"| {' | '.join([f'**{name}**' if row.point.default else name, *rest])} |"


def _has_default(points: Sequence[Row]) -> bool:
    return any(row.point.default for row in points)
