"""MkDocs hook: adds generated reference pages, and pages for linked files outside docs/.

The pages of `generated_pages` are stored in no file; each build generates them.

Pages of docs/ link to files outside that folder (`../../examples/template.py`), which works in a
checkout. A site holds only its own folder, so that each of those files gets a page under `source/`,
outside the navigation, to which the links lead.
"""

import os
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

from infra.setup.generated_pages import PAGES

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#:\s]+)(#[^)\s]*)?\)")
"""Relative link or picture: bang, words, target, anchor."""
PICTURES = (".webp", ".png", ".jpg", ".svg")
"""Suffixes of files that the site shows as they are; every other linked file is text."""


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages, and a page for every linked file outside docs/."""
    waiting = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    known = set(waiting)
    while waiting:
        page = waiting.pop()
        for match in LINK.finditer((ROOT / page).read_text()):
            target = _resolve_link(page, match[3])
            if target in known or target.startswith("docs/") or not (ROOT / target).is_file():
                continue
            known.add(target)
            added = File.generated(config, _site_uri(target), content=_source_page(target))
            added.inclusion = InclusionLevel.NOT_IN_NAV
            files.append(added)
            if target.endswith(".md"):
                waiting.append(target)
    for name, page_text in PAGES.items():
        files.append(File.generated(config, f"reference/{name}.md", content=page_text()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point links out of docs/ to the pages under `source/`; remove links without such a page."""
    page_uri = page.file.src_uri
    origin = (
        page_uri.removeprefix("source/") if page_uri.startswith("source/") else f"docs/{page_uri}"
    )

    def replace_link(match: re.Match[str]) -> str:
        bang = match[1]
        words = match[2]
        target = match[3]
        anchor = match[4] or ""
        path = _resolve_link(origin, target)
        if not origin.startswith("docs/") or not path.startswith("docs/"):
            if files.get_file_from_path(_site_uri(path)) is None:
                return words
            target = posixpath.relpath(_site_uri(path), posixpath.dirname(page_uri) or ".")
        return f"{bang}[{words}]({target}{anchor})"

    return LINK.sub(replace_link, markdown)


def _resolve_link(page: str, target: str) -> str:
    """Return a link's target as a path below the checkout."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target))


def _site_uri(path: str) -> str:
    """Return the MkDocs source path of a file of the checkout."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"source/{path}" if path.endswith((".md", *PICTURES)) else f"source/{path}.md"


def _source_page(path: str) -> str | bytes:
    """Return a picture as it is, and another file as a page of Markdown."""
    if path.endswith(PICTURES):
        return (ROOT / path).read_bytes()
    text = (ROOT / path).read_text()
    if path.endswith(".md"):
        return text
    language = os.path.splitext(path)[1].lstrip(".") or "text"
    return f"# `{path}`\n\n````{language}\n{text}````\n"
