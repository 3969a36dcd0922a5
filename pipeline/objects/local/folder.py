"""Objects of a local folder: the rows of its catalogue, or else its object files."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.foreign.limits import SUFFIXES
from pipeline.objects.file_filters import (
    drop_duplicates,
    drop_outputs,
    drop_scenes,
    warn_unread_formats,
)
from pipeline.objects.licences import StatedLicence, require_unstated, stated_licence
from pipeline.objects.listing import Listing, assign_uids, failure, is_object_file
from pipeline.objects.local.catalogue import only_catalogue, read_catalogue
from storage.errors import Rejected, TrilightError
from storage.records.objects import ObjectRecord
from storage.remote.retries import TransferFailed
from storage.remote.safe_url import printable


def list_folder(folder: Path, licence: str | None) -> Listing:
    """Return the objects of a folder; nothing is loaded.

    Args:
        folder: with a catalogue or object files.
        licence: the user's licence for files without a statement.

    Raises:
        TrilightError: the folder is missing or not a folder, its catalogue is wrong, it has two
            catalogues, or a catalogue and a `licence`.
    """
    display_path = printable(str(folder))
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise TrilightError(
            f"objects {display_path!r} {problem}; expected a folder of {' '.join(SUFFIXES)} "
            "files, or procedural: for built-in objects."
        )
    catalogue = only_catalogue(lambda name: (folder / name).exists())
    if catalogue is None:
        return scan_folder(folder, stated_licence(licence))
    require_unstated(licence, catalogue)
    return Listing(records=read_catalogue(folder / catalogue), failures=[])


def scan_folder(folder: Path, licence: StatedLicence) -> Listing:
    """Return a record for every object file below `folder`, at any depth.

    Hidden files are left out (macOS writes `._name.obj` next to `name.obj`), and linked folders are
    not entered. A link out of the folder is a failure `link_outside` of that object.

    Raises:
        TrilightError: a folder cannot be read.
    """
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
    licence: StatedLicence,
    locate: Callable[[str], dict[str, str]],
    drop_more: Callable[[list[str]], list[str]] = list,
) -> Listing:
    """Return a record for every object file of a folder; copies and outputs are left out.

    Args:
        names: all files of the folder, with / between the parts of their paths.
        licence: licence of every file.
        locate: returns the fields of a file's record that say where it is; raises Rejected or
            TransferFailed, which becomes a failure of that object.
        drop_more: returns the object files without others that are none.
    """
    names = drop_outputs(names)
    files = [name for name in names if is_object_file(name)]
    warn_unread_formats(names, files)
    uids, failures = assign_uids(drop_duplicates(drop_more(files)))
    records = []
    for name, uid in uids.items():
        try:
            records.append(replace(file_record(uid, "", licence), **locate(name)))
        except (Rejected, TransferFailed) as error:
            failures.append(failure(uid, error.reason, error.message))
    return Listing(records=records, failures=failures)


def is_below(root: Path, path: Path) -> bool:
    """Return True where a file is inside a folder after following links."""
    # Not Path.resolve: links that go round in a circle make it raise.
    return Path(os.path.realpath(path)).is_relative_to(root)


def file_record(uid: str, path: str, licence: StatedLicence) -> ObjectRecord:
    """Return the record of a file without a catalogue row."""
    return ObjectRecord(
        uid=uid,
        path=path,
        title=uid.rpartition("/")[2],
        licence=licence.licence,
        licence_source=licence.licence_source,
        attribution="",
        source_url="",
    )


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
