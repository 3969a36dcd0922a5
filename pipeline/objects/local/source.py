"""Objects of a folder of this machine: by its catalogue, or else its object files."""

from pathlib import Path

from pipeline.objects.licences import require_unstated, stated_licence
from pipeline.objects.listing import Listing
from pipeline.objects.local.catalogue import only_catalogue, read_catalogue
from pipeline.objects.local.folder import scan_folder
from pipeline.objects.uids import SUFFIXES
from storage.errors import TrilightError
from storage.remote.safe_url import printable


def list_folder(folder: Path, licence: str | None) -> Listing:
    """Return the objects of a folder; nothing is loaded.

    Args:
        folder: its catalogue is used where it has one, and its object files otherwise.
        licence: of files without a statement, as the user states it.

    Raises:
        TrilightError: the folder is missing or is no folder, its catalogue is wrong, there are
            two, or has a licence stated from outside.
    """
    shown = printable(str(folder))
    if not folder.is_dir():
        found = "is not a folder" if folder.exists() else "does not exist"
        raise TrilightError(
            f"objects {shown!r} {found}; expected a folder of {' '.join(SUFFIXES)} files, or "
            "builtin: for built-in objects."
        )
    catalogue = only_catalogue(lambda name: (folder / name).exists())
    if catalogue is None:
        return scan_folder(folder, stated_licence(licence))
    require_unstated(licence, catalogue)
    return Listing(records=read_catalogue(folder / catalogue), failures=[])
