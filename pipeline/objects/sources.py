"""Where objects come from, as one list of records: a folder, a catalogue, or the built-in families.

Nothing is loaded here: a record names a file, and the mesh stage finds out whether it is any good.
"""

from pathlib import Path

from pipeline.objects.catalogue import CATALOGUE_NAME, read_catalogue
from pipeline.objects.folder import SUFFIXES, scan_folder
from pipeline.objects.generated import PREFIX, generate_objects
from pipeline.objects.names import printable
from storage.errors import TrilightError
from storage.records import ObjectRecord


def list_objects(source: str, *, work_dir: Path) -> list[ObjectRecord]:
    """Return the objects of a source, sorted by uid.

    Args:
        source: a folder, whose `objects.jsonl` is used where it has one, and whose object files
            otherwise; or `builtin:` (64 procedural objects), or `builtin:N`.
        work_dir: where built-in objects are written; not touched for folders.

    Raises:
        TrilightError: the folder is missing, is no folder or holds no objects; its catalogue has a
            mistake; uids repeat; the count of `builtin:N` makes no sense.
    """
    if source.startswith(PREFIX):
        records = generate_objects(source, work_dir)
    else:
        records = _list_folder(Path(source).expanduser())
    return sorted(records, key=lambda record: record.uid)


def _list_folder(folder: Path) -> list[ObjectRecord]:
    shown = printable(str(folder))
    if not folder.is_dir():
        found = "is not a folder" if folder.exists() else "does not exist"
        raise TrilightError(
            f"objects {shown!r} {found}; expected a folder of {' '.join(SUFFIXES)} files, or "
            f"{PREFIX} for built-in objects."
        )
    has_catalogue = (folder / CATALOGUE_NAME).exists()
    records = read_catalogue(folder) if has_catalogue else scan_folder(folder)
    if not records:
        raise TrilightError(
            f"objects {shown!r} holds no object; expected {' '.join(SUFFIXES)} files"
            f"{f' listed in its {CATALOGUE_NAME}' if has_catalogue else ''}, or name {PREFIX} for "
            "built-in objects."
        )
    return records
