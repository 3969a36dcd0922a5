"""The one way to make HTML escapes all that is not its own; figures draw what they are given."""

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
from pipeline.documents.html import (
    Markup,
    element,
    escape,
    image,
    joined,
    outside_link,
    page,
    png_uri,
    table,
)
from tests.pipeline.documents.pages_read import HARM, read


def test_text_is_escaped_once() -> None:
    assert escape("<&'\">") == "&lt;&amp;&#x27;&quot;&gt;"
    assert escape(escape("<")) == "&lt;"
    assert joined(["<", Markup("<br>")]) == "&lt;\n<br>"


def test_attributes_cannot_be_left() -> None:
    tags = read(element("p", HARM, id=HARM, class_="a").encode())
    assert (tags.tags, tags.names, tags.ids) == (["p"], {"id", "class"}, {HARM})
    assert read(image("data:,", HARM).encode()).tags == ["img"]


def test_cells_and_titles_are_text() -> None:
    tags = read(page(HARM, table((HARM, "n"), [(HARM, 1), ("b", 2)], numbers=1)))
    assert tags.tags.count("td") == 4
    assert "".join(tags.text).count(HARM) == 3
    assert not {"script", "iframe"} & set(tags.tags)


def test_only_the_script_of_a_page_runs() -> None:
    text = page("x", "y", script="show()").decode()
    assert "<script>show()</script>" in text
    # sha256 of "show()", as openssl dgst -binary | base64 gives it
    assert "script-src 'sha256-bZcXq6A55386WOhnm+CkmXOdvD/gkjsQT5fkz6gxfg8='\"" in text


def test_only_the_last_columns_are_numbers() -> None:
    assert str(table(("a", "b"), [("x", 1)], numbers=1)).count('class="n"') == 2
    assert "class" not in table((), [("x", "y")])
    assert "<th>" not in table((), [("x", "y")])
    assert table((), []) == "<table></table>"


def test_addresses_become_links() -> None:
    for url in ["https://example.org/a?b=c&d", "http://localhost:80/x", "HTTPS://E.org"]:
        tags = read(outside_link(url).encode())
        assert (tags.tags, tags.links, "".join(tags.text)) == (["a"], [url], url)


def test_other_addresses_stay_text() -> None:
    for url in [
        "",
        "javascript:alert(1)",
        "JaVaScript:alert(1)",
        " https://example.org",
        "java\nscript:alert(1)",
        "data:text/html,x",
        "file:///etc/passwd",
        "//example.org",
        "https://",
        "https://me:secret@example.org",
        "https://[broken",
        "https://e.org/\u202egro",
        "a file.glb",
        HARM,
    ]:
        tags = read(outside_link(url).encode())
        assert (tags.tags, "".join(tags.text)) == ([], url)


def test_a_lone_surrogate_is_no_error() -> None:
    assert b"?" in page("x", "\ud800")


def test_equal_pictures_give_equal_addresses() -> None:
    picture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert png_uri(picture) == png_uri(picture.copy())
    assert png_uri(picture).startswith("data:image/png;base64,")


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
