"""Markdown, YAML and cells of CSV in which untrusted text never becomes markup or a formula."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

_SPECIAL = re.compile(r"[\\`*_\[\]|#~!$]")
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
_ENTITIES = {"&": "&amp;", "<": "&lt;", ">": "&gt;"}


def plain(value: object) -> str:
    """Return a value as one line; line ends and unprintable characters become spaces."""
    return "".join(c if c.isprintable() else " " for c in str(value)).strip()


def text(value: object) -> str:
    """Return a value as one line of Markdown that shows it unchanged."""
    escaped = _SPECIAL.sub(r"\\\g<0>", plain(value))
    return "".join(_ENTITIES.get(c, c) for c in escaped)


def code(value: object) -> str:
    """Return a value as a code span; a backtick becomes an apostrophe."""
    inner = plain(value).replace("`", "'").replace("|", "\\|")
    return f"`{inner}`" if inner else ""


def inert(cell: str) -> str:
    """Return untrusted text, escaped so that a spreadsheet reads no formula in it."""
    return f"'{cell}" if cell.startswith(_FORMULA_STARTS) else cell


def table(head: Sequence[str], rows: Sequence[Sequence[object]], *, numbers: int = 0) -> str:
    """Return a table of Markdown cells, the last `numbers` columns aligned to the right."""
    marks = ["---"] * (len(head) - numbers) + ["---:"] * numbers
    lines = [head, marks, *rows]
    assert {len(line) for line in lines} == {len(head)}, head
    return "\n".join(f"| {' | '.join(str(cell) for cell in line)} |" for line in lines)


def front_matter(values: Mapping[str, Any]) -> str:
    """Return values (texts, numbers, lists and mappings of them) as a block of YAML.

    Keys are trusted and not quoted; every text is quoted as JSON, which YAML reads.
    """
    return "\n".join(["---", *_lines(values), "---"])


def _lines(value: Any) -> list[str]:
    if isinstance(value, Mapping):
        return [line for key, entry in value.items() for line in _entry(f"{key}:", entry)]
    lines = []
    for entry in value:
        first, *rest = _lines(entry) if isinstance(entry, Mapping) else [_scalar(entry)]
        lines += [f"- {first}", *(f"  {line}" for line in rest)]
    return lines


def _entry(key: str, value: Any) -> list[str]:
    if isinstance(value, str | int | float):
        return [f"{key} {_scalar(value)}"]
    return [key, *(f"  {line}" for line in _lines(value))] if value else [f"{key} []"]


def _scalar(value: str | int | float) -> str:
    return json.dumps(plain(value) if isinstance(value, str) else value, ensure_ascii=False)
