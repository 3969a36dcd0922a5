"""Object files of a folder that has no catalogue."""

import os
from pathlib import Path

from pipeline.objects.licences import StatedLicence
from pipeline.objects.listing import Listing, failure
from pipeline.objects.uids import assign_uids, is_object_file
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.remote.safe_url import printable


def scan_folder(folder: Path, licence: StatedLicence) -> Listing:
    """Return a record for every object file below `folder`, at any depth.

    Hidden files are left out (other systems leave `._name.obj` beside `name.obj`), and linked
    folders are not entered. A link out of the folder is a failure `link_outside` of that object.

    Raises:
        TrilightError: a folder cannot be read.
    """
    root = Path(os.path.realpath(folder))
    uids, failures = assign_uids(_object_files(root))
    records = []
    for name, uid in uids.items():
        # Not Path.resolve: links that go round in a circle make it raise.
        if not Path(os.path.realpath(root / name)).is_relative_to(root):
            message = (
                f"{printable(name)} is a link out of the folder; copy the file into it, or name "
                "the folder that holds it"
            )
            failures.append(failure(uid, "link_outside", message))
            continue
        records.append(file_record(uid, str(root / name), licence))
    return Listing(records=records, failures=failures)


def file_record(
    uid: str, path: str, licence: StatedLicence, *, source_url: str = ""
) -> ObjectRecord:
    """Return the record of a file that nothing is said about."""
    return ObjectRecord(
        uid=uid,
        path=path,
        title=uid.rpartition("/")[2],
        licence=licence.licence,
        licence_source=licence.licence_source,
        attribution="",
        source_url=source_url,
    )


def _object_files(root: Path) -> list[str]:
    """Return the paths of the object files relative to `root`, with / between their parts."""

    def stop(error: OSError) -> None:
        raise TrilightError(
            f"{printable(str(error.filename))}: cannot be read ({error.strerror}); expected a "
            "readable folder. Mend its permissions or move it away."
        )

    found = []
    for place, folders, files in os.walk(root, onerror=stop):
        folders[:] = [name for name in folders if not name.startswith(".")]
        inner = Path(place).relative_to(root)
        found += [(inner / name).as_posix() for name in files if is_object_file(name)]
    return found
