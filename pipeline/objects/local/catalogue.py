"""Catalogues: `objects.jsonl` or `objects.csv`, a row per object with its file and its rights.

A mistake in it stops the run, since it is the user's text; a file that it names and that is missing
does not, since one lost download must not cost the others.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.objects.licences import UNKNOWN
from pipeline.objects.local.catalogue_rows import csv_rows, jsonl_rows
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.remote.safe_url import printable, public_text

CATALOGUE_NAMES = ("objects.jsonl", "objects.csv")


def only_catalogue(exists: Callable[[str], bool]) -> str | None:
    """Return the name of a folder's catalogue, or None where it has none.

    Args:
        exists: says whether the folder has a file of a name.

    Raises:
        TrilightError: it has both.
    """
    found = [name for name in CATALOGUE_NAMES if exists(name)]
    if len(found) > 1:
        raise TrilightError(
            f"objects: the folder has {' and '.join(found)}; expected one catalogue. Remove one."
        )
    return found[0] if found else None


def read_catalogue(path: Path) -> list[ObjectRecord]:
    """Return the records of a catalogue, in its order.

    `uid` and `path` (below the folder of the catalogue) are required; `title` falls back to the
    uid, `licence` to LicenseRef-unknown (which the default allow-list refuses), `licence_source` to
    the name of the catalogue, `attribution` and `source_url` to nothing. Other fields are ignored.

    Raises:
        TrilightError: a row is malformed, a field is missing or no text, a uid is empty, not
            printable or used twice, or a path leads out of the folder; names file and line.
    """
    root = Path(os.path.realpath(path.parent))
    records: list[ObjectRecord] = []
    line_of: dict[str, int] = {}
    rows = csv_rows(path) if path.suffix == ".csv" else jsonl_rows(path)
    for number, row in rows:
        place = f"{path.name}:{number}"
        record = _record(root, row, place, path.name)
        if record.uid in line_of:
            raise TrilightError(
                f"{place}: uid {record.uid!r} is already used in line {line_of[record.uid]}; "
                "expected one line per object. Rename or remove one of them."
            )
        line_of[record.uid] = number
        records.append(record)
    return records


def _record(root: Path, row: dict[str, Any], place: str, name: str) -> ObjectRecord:
    uid, path = _text(row, "uid", place), _text(row, "path", place)
    if uid != printable(uid) or not uid.strip():
        raise TrilightError(
            f"{place}: uid is {printable(uid)!r}; expected printable text that is not blank."
        )
    return ObjectRecord(
        uid=uid,
        path=str(_inside(root, path, place)),
        title=_published(row, "title", place, uid),
        licence=_published(row, "licence", place, UNKNOWN),
        licence_source=_published(row, "licence_source", place, name),
        attribution=_published(row, "attribution", place, ""),
        source_url=_published(row, "source_url", place, ""),
    )


def _published(row: dict[str, Any], field: str, place: str, default: str) -> str:
    """Return a text that stands in the dataset's documents: printable, without passwords."""
    return printable(public_text(_text(row, field, place, default)))


def _text(row: dict[str, Any], field: str, place: str, default: str | None = None) -> str:
    value = row.get(field, default)
    if not isinstance(value, str):
        found = f"a {type(value).__name__}" if field in row else "missing"
        raise TrilightError(f"{place}: field {field!r} is {found}; expected text.")
    return value


def _inside(root: Path, path: str, place: str) -> Path:
    """Return the absolute place of a catalogue path; links are followed before it is judged."""
    shown = printable(path)
    if not path or "\x00" in path or path != path.encode("utf-8", "ignore").decode():
        raise TrilightError(f"{place}: path is {shown!r}; expected the name of a file.")
    target = Path(os.path.realpath(root / path))
    if not target.is_relative_to(root) or target == root:
        raise TrilightError(
            f"{place}: path {shown!r} leads out of the folder; expected a path below it. "
            "Copy the file into the folder."
        )
    return target
