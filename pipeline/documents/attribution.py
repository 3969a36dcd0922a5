"""`attribution.csv`: whom to thank for each object, and what its licence asks for."""

import csv
import io
from collections.abc import Iterable

from storage.atomic import write_atomically
from storage.layout import DatasetFolder
from storage.records import LockedObject

_COLUMNS = ("uid", "title", "licence", "attribution", "source_url", "split", "changes")
_CHANGES = "cleaned, remeshed and given new materials"
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def write_attribution(folder: DatasetFolder, objects: Iterable[LockedObject]) -> None:
    """Write one row per object that the dataset may use, sorted by uid."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for entry in sorted(objects, key=lambda row: row.uid):
        row = (entry.uid, entry.title, entry.licence, entry.attribution, entry.source_url)
        writer.writerow([_inert(cell) for cell in (*row, entry.split, _CHANGES)])
    write_atomically(folder.attribution, stream.getvalue().encode())


def _inert(cell: str) -> str:
    """Text from outside must not become a formula when a spreadsheet opens the file."""
    return f"'{cell}" if cell.startswith(_FORMULA_STARTS) else cell
