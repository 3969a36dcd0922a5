"""Reads pages as a browser would, and holds text and rows of objects that mean harm."""

import dataclasses
from html.parser import HTMLParser
from typing import Any

from storage.records.asset import AssetRow
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE

HARM = """<script>alert(1)</script><img src=x onerror=alert(2)>"'&"""
VOID = {"meta", "img", "br", "input"}


class Tags(HTMLParser):
    """Collects tags, attributes and text, and checks that tags close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.names: set[str] = set()
        self.ids: set[str] = set()
        self.styles: set[str] = set()
        self.text: list[str] = []
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.names.update(name for name, _ in attrs)
        self.styles.update(value or "" for name, value in attrs if name == "style")
        self.ids.update(value or "" for name, value in attrs if name == "id")
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def text_of(tags: Tags) -> str:
    """Return the text of a page with single spaces."""
    return " ".join(" ".join(tags.text).split())


def read(page: bytes) -> Tags:
    tags = Tags()
    tags.feed(page.decode())
    tags.close()
    assert tags._open == []
    return tags


def row(uid: str = "made/ball", **changes: Any) -> AssetRow:
    plain = AssetRow(
        uid=uid,
        path="meshes/ball.ply",
        title="Ball",
        licence="CC0-1.0",
        licence_source="tests",
        attribution="its maker",
        source_url="https://example.org/ball",
        num_faces=1280,
        method="source",
        quality=QUALITY,
        source=SOURCE,
    )
    return dataclasses.replace(plain, **changes)
