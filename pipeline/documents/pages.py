"""Pages and Markdown from the templates in `templates/`, in which all text is escaped.

Only the text of a template is markup. Pages load nothing; all have the same style and may run one
script.
"""

import base64
import hashlib
import itertools
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup  # of jinja2
from numpy.typing import NDArray

from pipeline.documents.png import encode_png
from storage.licences import DUTIES, duties_of, licence_url, union_of_duties
from storage.markdown import code, text
from storage.records.quantities import summary


class Figure(NamedTuple):
    """Picture that can be enlarged."""

    source: str
    """Address, often of the data itself."""
    name: str
    """Text in place of the picture."""
    caption: str


_TEMPLATES = Path(__file__).with_name("templates")
_SCRIPT = (_TEMPLATES / "page.js").read_text()


def render_page(template: str, title: str, **values: object) -> bytes:
    """Return a page by a file of `templates/`, which shows the values."""
    page = _PAGES.get_template(template).render(title=title, **values)
    # a lone surrogate, which untrusted JSON may hold, has no UTF-8
    return page.encode(errors="replace")


def render_markdown(template: str, **values: object) -> bytes:
    """Return a document in Markdown; arguments are those of `render_page`."""
    return _MARKDOWN.get_template(template).render(**values).encode(errors="replace")


def is_address(url: str) -> bool:
    """Return True where an untrusted text is a plain http or https address, fit for a link."""
    try:
        parts = urlsplit(url)
        harmless = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        return False
    return harmless and "@" not in parts.netloc and url.isprintable() and " " not in url


def png_uri(pixels: NDArray[np.uint8]) -> str:
    """Return a picture, [H, W] grey or [H, W, 3] RGB, as a data URI."""
    return data_uri(encode_png(pixels))


def data_uri(picture: bytes, kind: str = "png") -> str:
    """Return the bytes of a picture file as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def _make_environment(**options: Any) -> Environment:
    return Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        **options,
    )


_PAGES = _make_environment()
_PAGES.tests["address"] = is_address
_PAGES.filters |= {"png": png_uri, "summary": summary}
_PAGES.globals |= {
    "Counter": Counter,
    "chain": itertools.chain.from_iterable,  # the sum of many tuples takes quadratic time
    "style": Markup((_TEMPLATES / "page.css").read_text()),
    "script": Markup(_SCRIPT),
    "script_sha256": base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode(),
}
_MARKDOWN = _make_environment(
    keep_trailing_newline=True,
    finalize=lambda value: value if isinstance(value, Markup) else Markup(text(value)),
)
_MARKDOWN.globals |= {
    "licence_url": licence_url,
    "duties_of": duties_of,
    "union_of_duties": union_of_duties,
    "duty_texts": DUTIES,
}
_MARKDOWN.tests["known_licence"] = lambda name: duties_of(name) is not None
_MARKDOWN.filters |= {
    "code": lambda value: Markup(code(value)),
    "extract": lambda name, values: values[name],
    "summary": summary,
}
