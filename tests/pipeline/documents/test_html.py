"""The one way to make HTML escapes everything that is not its own."""

import numpy as np

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
