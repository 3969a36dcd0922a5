"""Figures draw what they are given, whatever it is."""

import base64
import io

import matplotlib
import numpy as np
from PIL import Image

from pipeline.documents.figures import (
    drawing,
    encoded,
    histogram,
    panels,
    rose,
    short_label,
    stacked_bars,
)
from pipeline.documents.html import Markup


def picture(markup: Markup) -> Image.Image:
    data = str(markup).split("base64,")[1].split('"')[0]
    return Image.open(io.BytesIO(base64.b64decode(data)))


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


def test_any_values_can_be_drawn() -> None:
    marks = {"a": 3.0, "b": None, "c": np.nan}
    with drawing():
        figure, axes = panels(len(VALUES) + 4, polar=(0, 1, 2, 3))
        for axis, name in zip(axes, ("none", "equal", "wide", "not finite"), strict=False):
            rose(axis, VALUES[name], "directions")
        for axis, (name, values) in zip(axes[4:], VALUES.items(), strict=True):
            histogram(axis, values, name, ylabel="y", marks=marks)
        drawn = picture(encoded(figure, "alt"))
    assert drawn.size[0] > 800
    assert len(drawn.getcolors(1 << 24) or []) > 20


def test_bars_hold_every_value() -> None:
    """Heights of the bars add up to the values, and whole numbers have a bar each."""
    with drawing():
        _, (axes, other) = panels(2)
        histogram(axes, [1, 2, 2, 5], "x")
        histogram(other, np.linspace(0, 1, 1000), "x")
    heights = [patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]
    assert heights == [1, 2, 0, 0, 1]
    total = sum(patch.get_height() for patch in other.patches)  # type: ignore[attr-defined]
    assert total == 1000


def test_names_from_outside_are_labels() -> None:
    assert short_label("a\n b\x07\u202e") == "a b"
    assert len(short_label("x" * 99)) == 26
    names = ["$\\frac{$", "高 \ud800", "", "x" * 99]
    with drawing():
        figure, _ = stacked_bars(names, {name: [1, 2, 3, 4] for name in names}, xlabel="n")
        assert picture(encoded(figure, "alt")).size[0] > 800


def test_the_readers_settings_do_not_matter() -> None:
    def drawn() -> str:
        with drawing():
            figure, (axes,) = panels(1)
            histogram(axes, [1.5, 2.5], "x")
            return encoded(figure, "alt")

    plain = drawn()
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert drawn() == plain
        assert matplotlib.rcParams["font.size"] == 30
