"""Figures: any values, names from outside, whoever draws them."""

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from pipeline.documents.figures import (
    Panel,
    draw_bars,
    draw_histogram,
    draw_panels,
    short_label,
)

VALUES: dict[str, list[float]] = {
    "none": [],
    "one": [3.5],
    "equal": [2.5] * 9,
    "whole": [1, 2, 2, 5],
    "wide": [1e-9, 1e30],
    "not finite": [np.nan, np.inf, 1.0],
    "all not finite": [np.nan],
    "many": list(np.linspace(0, 1, 1000)),
}


def picture(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png))


def test_any_values_can_be_drawn() -> None:
    marks = {"a": 3.0, "c": np.nan}
    kinds: tuple[dict[str, Any], ...] = ({"is_rose": True}, {"is_log": True}, {"marks": marks})
    panels = [
        Panel(values=values, label=name, unit="y", **more)
        for more in kinds
        for name, values in VALUES.items()
    ]
    drawn = picture(draw_panels(panels))
    assert drawn.size[0] > 800
    assert len(drawn.getcolors(1 << 24) or []) > 20


def test_bars_hold_every_value_and_names_from_outside_are_labels() -> None:
    """Heights of the bars add up to the values, and whole numbers have a bar each."""

    def heights(values: list[float]) -> list[float]:
        axes = Figure().add_subplot()
        draw_histogram(axes, Panel(values=values, label="x"))
        return [patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]

    assert heights([1, 2, 2, 5]) == [1, 2, 0, 0, 1]
    assert sum(heights(VALUES["many"])) == 1000
    assert short_label("a\n b\x07\u202e") == "a b"
    assert len(short_label("x" * 99)) == 26
    names = ["$\\frac{$", "高 \ud800", "", "x" * 99]
    drawn = draw_bars(names, {name: [1, 2, 3, 4] for name in names}, label="n")
    assert picture(drawn).size[0] > 800


def test_the_readers_settings_do_not_matter() -> None:
    panel = Panel(values=[1.5, 2.5], label="x")
    plain = draw_panels([panel])
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert draw_panels([panel]) == plain
        assert matplotlib.rcParams["font.size"] == 30
