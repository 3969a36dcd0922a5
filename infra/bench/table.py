"""The one table of an experiment, for the terminal and for pages."""

from collections.abc import Iterator

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
    """Return one cell: decibels with one digit behind the point, n/a for what is not known."""
    value = row.values.get(column.name)
    if value is None:
        return "n/a"
    return f"{value:.1f}" if "dB" in column.name else shown(value)


def front_word(row: Row) -> str:
    """Return whether a point is on the front, in a word."""
    return {True: "yes", False: "no", None: "n/a"}[row.on_front]


def headings(experiment: Experiment) -> list[str]:
    """Return the heading of every column."""
    cost, *others = (column.name for column in columns_of(experiment))
    front = ["front"] if experiment.error else []
    return ["setting", cost, "ratio", *others, *front]


def cells(experiment: Experiment, run: Run, *, spread: bool = False) -> Iterator[list[str]]:
    """Yield the cells of every point; `spread` adds smallest and largest of the cost."""
    cost, *others = columns_of(experiment)
    for row in rows(experiment, run):
        price = shown_in(cost, row)
        if spread and row.cost_spread:
            price += f" ({shown(row.cost_spread.low)} to {shown(row.cost_spread.high)})"
        front = [front_word(row)] if experiment.error else []
        further = [shown_in(column, row) for column in others]
        name = f"{row.point.name}{' *' if spread and row.point.default else ''}"
        yield [name, price, f"{shown(row.cost_ratio)} x", *further, *front]


def markdown(experiment: Experiment, run: Run) -> Iterator[str]:
    """Yield the table as lines of Markdown, the default in bold."""
    names = headings(experiment)
    yield f"| {' | '.join(names)} |"
    yield f"|{'---|' * len(names)}"
    defaults = {row.point.name for row in rows(experiment, run) if row.point.default}
    for name, *rest in cells(experiment, run):
        yield f"| {' | '.join([f'**{name}**' if name in defaults else name, *rest])} |"
