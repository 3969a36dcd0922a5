"""Charts are whole markup, tell in words what they show, and place points where they belong."""

import re

from infra.run_page.charts import (
    BOTTOM,
    HEIGHT,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Line,
    drawn,
    heat_map,
)
from tests.pipeline.documents.pages_read import HARM, read


def test_a_curve_runs_from_corner_to_corner_and_is_told_in_words() -> None:
    chart = Chart(title="speed", lines=[Line(name="a", points=[(0, 0.0), (10, 100.0)])])
    shown = drawn(chart, 10)
    read(shown.encode())
    path = re.search(r'<path d="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)" class="line c0"', shown)
    assert path
    x0, y0, x1, y1 = map(float, path.groups())
    assert (x0, x1) == (LEFT, WIDTH - RIGHT)
    # 4 % of room above and below
    inner = HEIGHT - TOP - BOTTOM
    assert abs(y0 - (HEIGHT - BOTTOM - inner * 0.04 / 1.08)) < 0.1
    assert abs(y1 - (TOP + inner * 0.04 / 1.08)) < 0.1
    assert 'aria-label="speed. a: 0 at step 0, 100 at step 10"' in shown
    assert "<summary>numbers</summary>" in shown and "step 10: a 100" in shown


def test_stacked_lines_fill_the_height() -> None:
    lines = [
        Line(name="a", points=[(1, 1.0), (2, 3.0)]),
        Line(name="b", points=[(1, 3.0), (2, 1.0)]),
    ]
    shown = drawn(Chart(title="time", lines=lines, stacked=True), 2)
    paths = re.findall(r'<path d="M([^"]+)Z" class="area', shown)
    tops = [[float(p.split()[1]) for p in path.split("L")[:2]] for path in paths]
    inner = HEIGHT - TOP - BOTTOM
    # a quarter and three quarters, to the tenth of a pixel that is written
    assert abs(tops[0][0] - (TOP + 0.75 * inner)) < 0.06
    assert abs(tops[0][1] - (TOP + 0.25 * inner)) < 0.06
    assert tops[1] == [TOP, TOP]
    assert "a 75%" in shown and "b 25%" in shown


def test_marks_stand_at_their_steps_and_names_from_outside_stay_text() -> None:
    chart = Chart(title=HARM, lines=[Line(name=HARM, points=[(5, 1.0)])], marks=[5])
    page = read(drawn(chart, 10).encode())
    assert "script" not in page.tags and "circle" in page.tags, "one point is a dot"
    assert "spike at step 5" in page.text


def test_nothing_is_drawn_of_nothing() -> None:
    assert drawn(Chart(title="x", lines=[Line(name="a", points=[])]), 10) == ""
    assert heat_map("x", {"a": [(1, 0.0)]}) == ""


def test_a_heat_map_is_stronger_where_values_are_larger() -> None:
    shown = heat_map("update", {"first": [(1, 0.001), (2, 0.1)], "second": [(1, 0.01), (2, 0.0)]})
    read(shown.encode())
    opacities = [float(found) for found in re.findall(r'fill-opacity="([\d.]+)"', shown)]
    assert opacities[0] < opacities[2] < opacities[1] and opacities[3] == 0
    assert "second, step 1: 0.01" in shown
