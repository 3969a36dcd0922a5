"""Catalogues: `objects.jsonl` or `objects.csv`, a row per object with its file and its rights.

A mistake in a catalogue stops the run, since the user wrote it. A missing file does not, since one
lost download must not cost the others.
"""

import csv
import io
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.objects.licences import UNKNOWN
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.records.safe_read import read_plain
from storage.remote.safe_url import printable, public_text

CATALOGUE_NAMES = ("objects.jsonl", "objects.csv")


def only_catalogue(exists: Callable[[str], bool], kind: str = "objects") -> str | None:
    """Return the name of a folder's catalogue, or None where it has none.

    Args:
        exists: returns True where the folder has a file of this name.
        kind: name of the catalogue: objects, textures or skies.

    Raises:
        TrilightError: the folder has both.
    """
    present = [name for end in ("jsonl", "csv") if exists(name := f"{kind}.{end}")]
    if len(present) > 1:
        raise TrilightError(
            f"{kind}: the folder has {' and '.join(present)}; expected one catalogue. Remove one."
        )
    return present[0] if present else None


def read_catalogue(path: Path) -> list[ObjectRecord]:
    """Return the records of a catalogue, in its order.

    `uid` and `path` (below the folder of the catalogue) are required; `title` falls back to the
    uid, `licence` to LicenseRef-unknown (which the default allow-list refuses), `licence_source` to
    the name of the catalogue, `attribution` and `source_url` to nothing. Other fields are ignored.

    Raises:
        TrilightError: a row is malformed, a field is missing or not text, a uid is empty, not
            printable or used twice, or a path leads out of the folder; with file and line.
    """
    root = Path(os.path.realpath(path.parent))
    records: list[ObjectRecord] = []
    line_of: dict[str, int] = {}
    rows = csv_rows(path) if path.suffix == ".csv" else jsonl_rows(path)
    for number, row in rows:
        location = f"{path.name}:{number}"
        record = _record(root, row, location, path.name)
        if record.uid in line_of:
            raise TrilightError(
                f"{location}: uid {record.uid!r} is already used in line {line_of[record.uid]}; "
                "expected one line per object. Rename or remove one of them."
            )
        line_of[record.uid] = number
        records.append(record)
    return records


def _record(root: Path, row: dict[str, Any], location: str, name: str) -> ObjectRecord:
    uid = _text(row, "uid", location)
    path = _text(row, "path", location)
    if uid != printable(uid) or not uid.strip():
        raise TrilightError(
            f"{location}: uid is {printable(uid)!r}; expected printable text that is not blank."
        )
    defaults = {"title": uid, "licence": UNKNOWN, "licence_source": name}
    defaults |= {"attribution": "", "source_url": ""}
    texts = {  # for the dataset's documents: printable, without passwords
        field: printable(public_text(_text(row, field, location, default)))
        for field, default in defaults.items()
    }
    path = str(_path_below(root, path, location))
    return ObjectRecord(uid=uid, path=path, root=str(root), **texts)


def _text(row: dict[str, Any], field: str, location: str, default: str | None = None) -> str:
    value = row.get(field, default)
    if not isinstance(value, str):
        actual = f"a {type(value).__name__}" if field in row else "missing"
        raise TrilightError(f"{location}: field {field!r} is {actual}; expected text.")
    return value


def _path_below(root: Path, path: str, location: str) -> Path:
    """Return the absolute path of a catalogue path; links are followed before the check."""
    display_path = printable(path)
    if not path or "\x00" in path or path != path.encode("utf-8", "ignore").decode():
        raise TrilightError(f"{location}: path is {display_path!r}; expected the name of a file.")
    target = Path(os.path.realpath(root / path))
    if "\\" in path and not target.exists():  # as a program on Windows writes it
        target = Path(os.path.realpath(root / path.replace("\\", "/")))
    if not target.is_relative_to(root) or target == root:
        raise TrilightError(
            f"{location}: path {display_path!r} leads out of the folder; expected a path below it. "
            "Copy the file into the folder."
        )
    return target


def jsonl_rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield line numbers from 1 and JSON objects; blank lines are skipped.

    Raises:
        TrilightError: the file is not UTF-8 text, or a line is not a JSON object.
    """
    for number, line in enumerate(_file_text(path).split("\n"), start=1):
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


def csv_rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield line numbers from 1 and the cells that are not blank, by column name.

    Raises:
        TrilightError: the file is not UTF-8 text or breaks the rules of CSV, the first row lacks
            `uid` or `path` or has a name twice, or a row has another number of cells.
    """
    names: list[str] = []
    for number, cells in _csv_lines(path):
        if not names:
            names = _header(cells, f"{path.name}:{number}")
            continue
        if len(cells) != len(names):
            raise TrilightError(
                f"{path.name}:{number}: has {len(cells)} cells; expected {len(names)}, as in the "
                "first row. Put text with commas or line breaks in quotes."
            )
        yield number, {name: cell for name, cell in zip(names, cells, strict=True) if cell.strip()}


def _header(cells: list[str], location: str) -> list[str]:
    names = [cell.strip() for cell in cells]
    columns = printable(", ".join(names))
    if not {"uid", "path"} <= set(names):
        raise TrilightError(
            f"{location}: the columns are {columns!r}; expected uid and path among them, with "
            "commas between them."
        )
    if len(set(names)) < len(names):
        raise TrilightError(f"{location}: the columns are {columns!r}; expected each name once.")
    return names


def _csv_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    # newline="" leaves line breaks inside of quotes as they are
    reader = csv.reader(io.StringIO(_file_text(path), newline=""), strict=True)
    while True:
        start = reader.line_num + 1
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise TrilightError(
                f"{path.name}:{start}: not CSV ({error}); expected cells with commas between "
                "them, and double quotes around text that holds commas, quotes or line breaks."
            ) from error
        if any(cell.strip() for cell in cells):
            yield start, cells


def _file_text(path: Path) -> str:
    try:
        return read_plain(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise TrilightError(
            f"{path.name}: cannot be read ({reason}); expected a file of UTF-8 text. Fix or "
            "remove it."
        ) from error
