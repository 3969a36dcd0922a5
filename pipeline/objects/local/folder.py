"""Objects of a local folder: the rows of its catalogue, or else its object files.

A catalogue is `objects.jsonl` or `objects.csv`, a row per object with its file and its rights. A
mistake in a catalogue stops the run, since the user wrote it. A missing file does not, since one
lost download must not cost the others.
"""

import csv
import io
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.foreign.limits import SUFFIXES
from pipeline.objects.file_filters import (
    drop_duplicates,
    drop_outputs,
    drop_scenes,
    warn_unread_formats,
)
from pipeline.objects.licences import UNKNOWN, require_unstated, stated_licence
from pipeline.objects.listing import Listing, assign_uids, failure
from storage.errors import Rejected, TrilightError
from storage.records.objects import ObjectRecord
from storage.records.safe_read import read_plain
from storage.remote.transfers import TransferFailed
from storage.remote.url import printable, public_text

CATALOGUE_NAMES = ("objects.jsonl", "objects.csv")


def only_catalogue(
    exists: Callable[[str], bool], licence: str | None, kind: str = "objects"
) -> str | None:
    """Return the name of a folder's catalogue, or None where it has none.

    Args:
        exists: returns True where the folder has a file of this name.
        licence: the user's licence for files without a statement.
        kind: name of the catalogue: objects, textures or skies.

    Raises:
        TrilightError: the folder has both, or a catalogue and a `licence`.
    """
    present = [name for end in ("jsonl", "csv") if exists(name := f"{kind}.{end}")]
    if len(present) > 1:
        raise TrilightError(
            f"{kind}: the folder has {' and '.join(present)}; expected one catalogue. Remove one."
        )
    if not present:
        return None
    require_unstated(licence, present[0])
    return present[0]


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
    for number, line in enumerate(file_text(path).split("\n"), start=1):
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
    # newline="" leaves line breaks inside of quotes as they are
    reader = csv.reader(io.StringIO(file_text(path), newline=""), strict=True)
    names: list[str] = []
    while True:
        number = reader.line_num + 1
        location = f"{path.name}:{number}"
        try:
            cells = next(reader, None)
        except csv.Error as error:
            raise TrilightError(
                f"{location}: not CSV ({error}); expected cells with commas between "
                "them, and double quotes around text that holds commas, quotes or line breaks."
            ) from error
        if cells is None:
            return
        if not any(cell.strip() for cell in cells):
            continue
        if not names:
            names = _header(cells, location)
            continue
        if len(cells) != len(names):
            raise TrilightError(
                f"{location}: has {len(cells)} cells; expected {len(names)}, as in the "
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


def file_text(path: Path) -> str:
    """Return the text of a file; raises TrilightError if it is not UTF-8 or cannot be read."""
    try:
        return read_plain(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise TrilightError(
            f"{printable(path.name)}: cannot be read ({reason}); expected a file of UTF-8 text. "
            "Fix or remove it."
        ) from error


def list_folder(folder: Path, licence: str | None) -> Listing:
    """Return the objects of a folder: the rows of its catalogue, or the object files at any depth.

    Nothing is loaded. Hidden files are left out (macOS writes `._name.obj` next to `name.obj`), and
    linked folders are not entered. A link out of the folder is a failure `link_outside` of that
    object.

    Args:
        folder: with a catalogue or object files.
        licence: the user's licence for files without a statement.

    Raises:
        TrilightError: the folder is missing, not a folder, or cannot be read, its catalogue is
            wrong, it has two catalogues, or a catalogue and a `licence`.
    """
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise TrilightError(
            f"objects {printable(str(folder))!r} {problem}; expected a folder of "
            f"{' '.join(SUFFIXES)} files, or procedural: for built-in objects."
        )
    if catalogue := only_catalogue(lambda name: (folder / name).exists(), licence):
        return Listing(records=read_catalogue(folder / catalogue))
    root = Path(os.path.realpath(folder))

    def locate(name: str) -> dict[str, str]:
        if not is_below(root, root / name):
            raise Rejected(
                "link_outside",
                f"{printable(name)} is a link out of the folder; copy the file into it, or name "
                "the folder that holds it",
            )
        return {"path": str(root / name), "root": str(root)}

    return list_files(walk_files(root), licence, locate, lambda names: drop_scenes(root, names))


def list_files(
    names: Sequence[str],
    licence: str | None,
    locate: Callable[[str], dict[str, str]],
    drop_more: Callable[[list[str]], list[str]] = list,
) -> Listing:
    """Return a record for every object file of a folder; copies and outputs are left out.

    Args:
        names: all files of the folder, with / between the parts of their paths.
        licence: the user's licence for files without a statement.
        locate: returns the fields of a file's record that say where it is; raises Rejected or
            TransferFailed, which becomes a failure of that object.
        drop_more: returns the object files without others that are none.

    Raises:
        TrilightError: `licence` does not have the form of an identifier.
    """
    stated = stated_licence(licence)
    names = drop_outputs(names)
    files = [
        name
        for name in names
        if name.lower().endswith(SUFFIXES) and not name.startswith(".") and "/." not in name
    ]
    warn_unread_formats(names, files)
    uids, failures = assign_uids(drop_duplicates(drop_more(files)))
    records = []
    for name, uid in uids.items():
        try:
            records.append(file_record(uid, {**stated, **locate(name)}))
        except (Rejected, TransferFailed) as error:
            failures.append(failure(uid, error.reason, error.message))
    return Listing(records=records, failures=failures)


def is_below(root: Path, path: Path) -> bool:
    """Return True where a file is inside a folder after following links."""
    # Not Path.resolve: links that go round in a circle make it raise.
    return Path(os.path.realpath(path)).is_relative_to(root)


def file_record(uid: str, stated: Mapping[str, str]) -> ObjectRecord:
    """Return the record of a file without a catalogue row; `stated` has its path and licence."""
    defaults = {"title": uid.rpartition("/")[2], "attribution": "", "source_url": ""}
    return ObjectRecord(uid=uid, **{**defaults, **stated})


def walk_files(root: Path) -> list[str]:
    """Return the paths of all files relative to `root`, with / between their parts.

    Hidden folders and linked ones are not entered.

    Raises:
        TrilightError: a folder cannot be read.
    """

    def stop(error: OSError) -> None:
        raise TrilightError(
            f"{printable(str(error.filename))}: cannot be read ({error.strerror}); expected a "
            "readable folder. Fix its permissions or move it away."
        )

    names: list[str] = []
    for folder, folders, files in os.walk(root, onerror=stop):
        folders[:] = [name for name in folders if not name.startswith(".")]
        inner = Path(folder).relative_to(root)
        names += [(inner / name).as_posix() for name in files]
    return names
