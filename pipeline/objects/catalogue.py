"""`objects.jsonl`: one JSON object per line that names a file of the folder and the rights to it.

A mistake in it stops the run, since it is the user's text; a file that it names and that is missing
does not, since one lost download must not cost the others.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.objects.licences import UNKNOWN
from pipeline.objects.names import printable
from storage.errors import TrilightError
from storage.records import ObjectRecord

CATALOGUE_NAME = "objects.jsonl"


def read_catalogue(folder: Path) -> list[ObjectRecord]:
    """Return the records of `folder`'s catalogue, in its order.

    `uid` and `path` are required; `title` falls back to the uid, `licence` to LicenseRef-unknown
    (which the default allow-list refuses), `attribution` and `source_url` to nothing. Other fields
    are ignored.

    Raises:
        TrilightError: a line is no JSON object, a field is missing or no text, a uid is empty, not
            printable or used twice, or a path leads out of the folder; names file and line.
    """
    root = folder.resolve()
    records: list[ObjectRecord] = []
    line_of: dict[str, int] = {}
    for number, row in _rows(folder / CATALOGUE_NAME):
        place = f"{CATALOGUE_NAME}:{number}"
        record = _record(root, row, place)
        if record.uid in line_of:
            raise TrilightError(
                f"{place}: uid {record.uid!r} is already used in line {line_of[record.uid]}; "
                "expected one line per object. Rename or remove one of them."
            )
        line_of[record.uid] = number
        records.append(record)
    return records


def _rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield line numbers from 1 and rows; blank lines are skipped."""
    try:
        lines = path.read_bytes().decode("utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise TrilightError(
            f"{path.name}: cannot be read ({error}); expected UTF-8 text with one JSON object per "
            "line. Mend or remove it."
        ) from error
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise TrilightError(
                f"{path.name}:{number}: not JSON ({error}); expected one object per line such as "
                '{"uid": "chair", "path": "chair.glb", "licence": "CC0-1.0"}.'
            ) from error
        if not isinstance(row, dict):
            raise TrilightError(
                f"{path.name}:{number}: got a {type(row).__name__}; expected a JSON object with "
                "uid and path."
            )
        yield number, row


def _record(root: Path, row: dict[str, Any], place: str) -> ObjectRecord:
    uid, path = _text(row, "uid", place), _text(row, "path", place)
    if uid != printable(uid) or not uid.strip():
        raise TrilightError(
            f"{place}: uid is {printable(uid)!r}; expected printable text that is not blank."
        )
    return ObjectRecord(
        uid=uid,
        path=str(_inside(root, path, place)),
        title=printable(_text(row, "title", place, uid)),
        licence=printable(_text(row, "licence", place, UNKNOWN)),
        attribution=printable(_text(row, "attribution", place, "")),
        source_url=printable(_text(row, "source_url", place, "")),
    )


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
    target = (root / path).resolve()
    if not target.is_relative_to(root) or target == root:
        raise TrilightError(
            f"{place}: path {shown!r} leads out of the folder; expected a path below it. "
            "Copy the file into the folder."
        )
    return target
