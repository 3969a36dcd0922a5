"""HTML pages that load nothing, and in which untrusted text never becomes markup.

Every function here escapes its arguments, unless they are `Markup`, which only these functions and
the documents themselves make.
"""

import base64
import hashlib
import html
from collections.abc import Iterable, Sequence
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.png import encode_png

Cell = str | int | float


class Markup(str):
    """Text that is HTML already. Text of a file must be escaped before it becomes Markup."""

    __slots__ = ()


STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #222; --soft: #667; --rule: #ddd;
  --box: #f6f6f6; --link: #1f5f99 }
@media (prefers-color-scheme: dark) { :root { --paper: #16181c; --ink: #e4e6ea; --soft: #a2a8b4;
  --rule: #383c44; --box: #1f2228; --link: #8ab8ee }
  img.wide { filter: invert(.9) hue-rotate(180deg) } }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem;
  color: var(--ink); background: var(--paper); padding: 0 1rem }
h1, h2, h3 { font-weight: 600; line-height: 1.25 } h2 { margin: 2.4rem 0 .6rem }
h3 { font-size: 1rem; margin: 1.2rem 0 .2rem }
a, summary { color: var(--link); text-decoration: none } a:hover { text-decoration: underline }
:focus-visible { outline: 2px solid var(--link); outline-offset: 2px }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums }
td, th { text-align: left; padding: .2rem .7rem .2rem 0; border-bottom: 1px solid var(--rule);
  vertical-align: top; overflow-wrap: anywhere }
th { font-weight: 600; overflow-wrap: normal }
td.n, th.n { text-align: right; overflow-wrap: normal }
.faint { color: var(--soft) } img.wide { max-width: 100% }
.command { user-select: all; background: var(--box); padding: .15rem .4rem; border-radius: 3px;
  overflow-wrap: anywhere }
pre { background: var(--box) } label:has(.zoom) { cursor: zoom-in }
.zoom { position: absolute; opacity: 0 }
.zoom:focus-visible + img { outline: 2px solid var(--link) }
.zoom:checked + img { position: fixed; inset: 0; margin: auto; z-index: 9; cursor: zoom-out;
  width: min(100vw, 100vh); height: min(100vw, 100vh); object-fit: contain; background: #000c;
  image-rendering: pixelated }
@media (max-width: 40rem) { body { margin-top: 1rem } }
@media (max-width: 78rem) {
  table:not(.narrow) { display: block; overflow-x: auto }
  table:not(.narrow) td { overflow-wrap: normal } }
table.narrow { width: auto } table.narrow td:first-child { overflow-wrap: break-word }
table.narrow td, table.narrow th { padding-right: 1.6rem }
@media (max-width: 30rem) { table.narrow td, table.narrow th { padding-right: .8rem } }
"""
"""Style sheet of all pages."""


def escape(text: object) -> Markup:
    """Return text as HTML that shows it unchanged; Markup is returned as it is."""
    return text if isinstance(text, Markup) else Markup(html.escape(str(text)))


def join_markup(parts: Iterable[str], separator: str = "\n") -> Markup:
    """Join parts, escaping those that are not Markup."""
    return Markup(separator.join(escape(part) for part in parts))


def element(tag: str, *content: object, **attributes: object) -> Markup:
    """Return `<tag ...>content</tag>`; a trailing `_` in an attribute's name is left out."""
    inner = "".join(escape(part) for part in content)
    return Markup(f"<{tag}{_attributes(attributes)}>{inner}</{tag}>")


def image(uri: str, alt: str, **attributes: object) -> Markup:
    """Return a picture."""
    return Markup(f"<img{_attributes({'alt': alt, **attributes, 'src': uri})}>")


def enlargeable(uri: str, alt: str) -> Markup:
    """Return a picture that a click or the space bar enlarges to the window and back."""
    mark = f"{html.escape(alt)}, fill the window"
    box = Markup(f'<input type="checkbox" class="zoom" aria-label="{mark}">')
    return element("label", box, image(uri, alt))


def table(
    head: Sequence[str], rows: Sequence[Sequence[Cell]], *, numbers: int = 0, **attributes: object
) -> Markup:
    """Return a table whose last `numbers` columns are aligned to the right; `head` may be empty."""
    first = max(len(head), *(len(row) for row in rows), 0) - numbers

    def line(tag: str, cells: Sequence[Cell]) -> Markup:
        return join_markup(
            (
                element(tag, cell, class_="n") if column >= first else element(tag, cell)
                for column, cell in enumerate(cells)
            ),
            "",
        )

    lines = [element("tr", line("td", row)) for row in rows]
    if head:
        lines.insert(0, element("tr", line("th", head)))
    return element("table", join_markup(lines), **attributes)


def page(title: str, body: str, *, style: str = "", script: str = "") -> bytes:
    """Return a complete page with the common style and `style`; only `script` may run."""
    policy = ""
    if script:
        sha256 = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        allowed = f"script-src 'sha256-{sha256}'"
        policy = f'<meta http-equiv="Content-Security-Policy" content="{allowed}">'
        body = join_markup([body, Markup(f"<script>{script}</script>")])
    text = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"{policy}<title>{escape(title)}</title><style>{STYLE}{style}</style></head><body>\n"
        f"{escape(body)}\n</body></html>\n"
    )
    # a lone surrogate, which untrusted JSON may hold, has no UTF-8
    return text.encode(errors="replace")


def outside_link(url: str) -> Markup:
    """Return a link to an external page, or only its text if it is not plain http or https."""
    text = str(url)
    try:
        parts = urlsplit(text)
        harmless = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        harmless = False
    if not harmless or "@" in parts.netloc or not text.isprintable() or " " in text:
        return escape(text)
    return element("a", text, href=text, rel="noreferrer noopener nofollow")


def png_uri(pixels: NDArray[np.uint8]) -> str:
    """Return a picture, [H, W] grey or [H, W, 3] RGB, as a data URI."""
    return data_uri(encode_png(pixels))


def data_uri(png: bytes) -> str:
    """Return the bytes of a PNG file as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _attributes(attributes: dict[str, object]) -> str:
    return "".join(
        f' {name.rstrip("_")}="{html.escape(str(value))}"' for name, value in attributes.items()
    )
