"""Rows of a catalogue file, as JSON lines or as CSV, each with the line where it begins."""

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from storage.errors import TrilightError
from storage.remote.safe_url import printable


def jsonl_rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield line numbers from 1 and JSON objects; blank lines are skipped.

    Raises:
        TrilightError: the file is no UTF-8 text, or a line is no JSON object.
    """
    for number, line in enumerate(_text(path).split("\n"), start=1):
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
    """Yield line numbers from 1 and the cells that are not blank, by the names of the first row.

    Raises:
        TrilightError: the file is no UTF-8 text or breaks the rules of CSV, the first row lacks
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


def _header(cells: list[str], place: str) -> list[str]:
    names = [cell.strip() for cell in cells]
    shown = printable(", ".join(names))
    if not {"uid", "path"} <= set(names):
        raise TrilightError(
            f"{place}: the columns are {shown!r}; expected uid and path among them, with commas "
            "between them."
        )
    if len(set(names)) < len(names):
        raise TrilightError(f"{place}: the columns are {shown!r}; expected each name once.")
    return names


def _csv_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    # newline="" leaves line breaks inside of quotes as they are
    reader = csv.reader(io.StringIO(_text(path), newline=""), strict=True)
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


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise TrilightError(
            f"{path.name}: cannot be read ({reason}); expected a file of UTF-8 text. Mend or "
            "remove it."
        ) from error
