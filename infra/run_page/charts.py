"""Charts as inline SVG: no script and no colour of their own, so that dark pages show them too.

A chart takes its colours from the page's style (classes c0, c1, ...), says in words what it shows
(aria-label), tells values where a pointer rests (<title>), and has the same in a table below it.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from infra.run_page.axes import Axis, axis_of, short_number
from infra.run_page.thinned import Point, thinned
from pipeline.documents.html import Markup, element, joined, table

WIDTH, HEIGHT = 460, 230
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 10, 28
COLOURS = 9
_TABLE_ROWS = 10
_STRIPS = 60


@dataclass(frozen=True, kw_only=True)
class Line:
    """One curve."""

    name: str
    """What the legend calls it."""
    points: Sequence[tuple[int, float]]
    """Step and finite value, in order."""
    faint: bool = False
    """Whether it is something to compare with, such as a baseline."""


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Curves over the steps of a run."""

    title: str
    """What the values are, with their unit."""
    lines: Sequence[Line]
    """One curve or several."""
    log: bool = False
    """Whether equal factors are equal heights, where all values allow it."""
    from_zero: bool = False
    """Whether the axis begins at 0."""
    marks: Sequence[int] = field(default_factory=tuple)
    """Steps that get a mark below."""
    stacked: bool = False
    """Whether the lines stand on each other; they then have their steps in common."""


def drawn(chart: Chart, last_step: int) -> Markup:
    """Return a chart with its caption, legend and numbers; empty where it has no point."""
    lines = [line for line in chart.lines if line.points]
    if not lines:
        return Markup("")
    body = _areas(lines, last_step) if chart.stacked else _curves(chart, lines, last_step)
    label = f"{chart.title}. {_in_words(lines)}"
    svg = element(
        "svg", *body, viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", **{"aria-label": label}
    )
    legend = _legend(lines, chart.stacked) if len(lines) > 1 else Markup("")
    latest = "" if len(lines) > 1 else f": {short_number(lines[0].points[-1][1])}"
    marked = element("span", " ▲ spike", class_="spike") if chart.marks else Markup("")
    caption = element("figcaption", element("b", chart.title), latest, marked, legend)
    return element("figure", caption, svg, _numbers(lines))


def _curves(chart: Chart, lines: Sequence[Line], last_step: int) -> list[Markup]:
    values = [value for line in lines for _, value in line.points]
    down = axis_of(values, log=chart.log, from_zero=chart.from_zero)
    along = Axis(0, max(last_step, 1))
    parts = [_grid(along, down)]
    for number, line in enumerate(lines):
        points = thinned(line.points)
        colour = "faint" if line.faint else f"c{number % COLOURS}"
        if len(lines) == 1 and any(point.high > point.low for point in points):
            parts.append(_band(points, along, down, colour))
        path = _path([(point.step, point.mean) for point in points], along, down)
        parts.append(element("path", d=path, class_=f"line {colour}"))
        if len(points) == 1:
            parts.append(_dot(points[0], along, down, colour))
    parts += [_mark(step, along) for step in chart.marks]
    return [*parts, *_strips(lines, along)]


def _areas(lines: Sequence[Line], last_step: int) -> list[Markup]:
    """Return the lines one upon the other, as shares of their sum."""
    along, down = Axis(0, max(last_step, 1)), Axis(0.0, 1.0)
    columns = [thinned(line.points) for line in lines]
    steps = [point.step for point in columns[0]]
    totals = [sum(column[row].mean for column in columns) or 1.0 for row in range(len(steps))]
    below, parts = [0.0] * len(steps), []
    for number, column in enumerate(columns):
        above = [
            low + point.mean / total
            for low, point, total in zip(below, column, totals, strict=True)
        ]
        there = list(zip(steps, above, strict=True))
        back = list(zip(reversed(steps), reversed(below), strict=True))
        path = _path(there + back, along, down) + "Z"
        parts.append(element("path", d=path, class_=f"area c{number % COLOURS}"))
        below = above
    return [*parts, _grid(along, down), *_strips(lines, along)]


def heat_map(title: str, layers: Mapping[str, Sequence[tuple[int, float]]]) -> Markup:
    """Return a row of cells for each layer, darker for larger values on a logarithmic scale."""
    values = [value for points in layers.values() for _, value in points if value > 0]
    if not values:
        return Markup("")
    scale = axis_of(values, log=True)
    row_px, left = 17, 165
    columns = [thinned(points, most=50) for points in layers.values()]
    cell = (WIDTH - left - RIGHT) / max(map(len, columns))
    parts = []
    for row, (layer, points) in enumerate(zip(layers, columns, strict=True)):
        top = row * row_px
        parts.append(_text(left - 6, top + 13, layer, anchor="end"))
        for column, point in enumerate(points):
            strength = 0.06 + 0.94 * scale.place(point.mean) if point.mean > 0 else 0.0
            tip = element("title", f"{layer}, step {point.step}: {short_number(point.mean)}")
            box = {"x": f"{left + column * cell:.1f}", "y": top, "width": f"{cell + 0.1:.1f}"}
            parts.append(
                element(
                    "rect", tip, **box, height=row_px - 1, **{"fill-opacity": f"{strength:.2f}"}
                )
            )
    height = row_px * len(layers)
    reach = f"{short_number(min(values))} (light) to {short_number(max(values))} (strong)"
    svg = element(
        "svg",
        *parts,
        viewBox=f"0 0 {WIDTH} {height}",
        role="img",
        class_="heat",
        **{"aria-label": f"{title} by layer over the steps, {reach}"},
    )
    lines = [Line(name=layer, points=points) for layer, points in layers.items()]
    caption = element("figcaption", element("b", title), f": {reach}")
    return element("figure", caption, svg, _numbers(lines))


def _grid(along: Axis, down: Axis) -> Markup:
    parts = []
    for tick in down.ticks():
        y = _y(down, tick)
        parts.append(_rule(LEFT, y, WIDTH - RIGHT, y))
        parts.append(_text(LEFT - 6, y + 4, short_number(tick), anchor="end"))
    for tick in along.ticks():
        x = _x(along, tick)
        parts.append(_text(x, HEIGHT - 8, short_number(tick), anchor="middle"))
        parts.append(_rule(x, HEIGHT - BOTTOM, x, HEIGHT - BOTTOM + 4))
    return element("g", *parts)


def _band(points: Sequence[Point], along: Axis, down: Axis, colour: str) -> Markup:
    there = [(point.step, point.high) for point in points]
    back = [(point.step, point.low) for point in reversed(points)]
    return element("path", d=_path(there + back, along, down) + "Z", class_=f"band {colour}")


def _dot(point: Point, along: Axis, down: Axis, colour: str) -> Markup:
    return element(
        "circle",
        cx=f"{_x(along, point.step):.1f}",
        cy=f"{_y(down, point.mean):.1f}",
        r=3,
        class_=f"dot {colour}",
    )


def _mark(step: int, along: Axis) -> Markup:
    x = _x(along, step)
    tip = element("title", f"spike at step {step}")
    y = HEIGHT - BOTTOM
    return element("path", tip, d=f"M{x:.1f} {y - 8}l-4 8h8z", class_="mark")


def _strips(lines: Sequence[Line], along: Axis) -> list[Markup]:
    """Return invisible columns that tell the values where a pointer rests on them."""
    points = thinned(lines[0].points, most=_STRIPS)
    edges = [_x(along, point.step) for point in points]
    found = []
    for row, point in enumerate(points):
        left = (edges[row - 1] + edges[row]) / 2 if row else edges[row] - 4
        right = (edges[row] + edges[row + 1]) / 2 if row + 1 < len(edges) else edges[row] + 4
        words = [f"{line.name} {_value_at(line, point.step)}" for line in lines]
        tip = element("title", f"step {point.step}: {', '.join(words)}")
        box = {"x": f"{left:.1f}", "y": TOP, "width": f"{max(right - left, 0.1):.1f}"}
        found.append(element("rect", tip, **box, height=HEIGHT - TOP - BOTTOM, class_="tip"))
    return found


def _value_at(line: Line, step: int) -> str:
    """Return the value at a step, or at the next one where there is none."""
    row = bisect_left(line.points, step, key=lambda point: point[0])
    return short_number(line.points[min(row, len(line.points) - 1)][1])


def _legend(lines: Sequence[Line], stacked: bool) -> Markup:
    """Return the colours with their names and last values; of stacked lines, last shares."""
    whole = sum(line.points[-1][1] for line in lines) or 1.0

    def last(line: Line) -> str:
        value = line.points[-1][1]
        return f"{value / whole:.0%}" if stacked else short_number(value)

    entries = [
        element(
            "span",
            element("i", class_="faint" if line.faint else f"c{number % COLOURS}"),
            f"{line.name} {last(line)}",
        )
        for number, line in enumerate(lines)
    ]
    return element("span", joined(entries, " "), class_="legend")


def _numbers(lines: Sequence[Line]) -> Markup:
    """Return some of the values as a table that is closed until it is asked for."""
    last = len(lines[0].points) - 1
    rows = sorted({round(last * row / (_TABLE_ROWS - 1)) for row in range(_TABLE_ROWS)})
    steps = [lines[0].points[row][0] for row in rows]
    cells = [[str(step), *(_value_at(line, step) for line in lines)] for step in steps]
    head = ["step", *(line.name for line in lines)]
    shown = table(head, cells, numbers=len(lines), class_="narrow")
    wide = element("div", shown, class_="scroll", tabindex=0)
    return element("details", element("summary", "numbers"), wide)


def _in_words(lines: Sequence[Line]) -> str:
    words = []
    for line in lines:
        (first, begun), (last, now) = line.points[0], line.points[-1]
        ends = f"{short_number(begun)} at step {first}, {short_number(now)} at step {last}"
        words.append(f"{line.name}: {ends}")
    return "; ".join(words)


def _path(points: Sequence[tuple[float, float]], along: Axis, down: Axis) -> str:
    places = [f"{_x(along, step):.1f} {_y(down, value):.1f}" for step, value in points]
    return "M" + "L".join(places)


def _x(along: Axis, step: float) -> float:
    return LEFT + (WIDTH - LEFT - RIGHT) * along.place(step)


def _y(down: Axis, value: float) -> float:
    return TOP + (HEIGHT - TOP - BOTTOM) * (1 - down.place(value))


def _rule(x1: float, y1: float, x2: float, y2: float) -> Markup:
    path = f"M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}"
    return element("path", d=path, class_="rule")


def _text(x: float, y: float, text: str, *, anchor: str) -> Markup:
    return element("text", text, x=f"{x:.1f}", y=f"{y:.1f}", **{"text-anchor": anchor})
