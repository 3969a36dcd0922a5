"""Object files of a folder that has no catalogue: taken as the user's own."""

import os
from pathlib import Path

from pipeline.objects.licences import USER_PROVIDED
from pipeline.objects.names import printable
from storage.errors import TrilightError
from storage.records import ObjectRecord

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")


def scan_folder(folder: Path) -> list[ObjectRecord]:
    """Return a record for every object file below `folder`, at any depth.

    The uid is the path within the folder without its suffixes (`banner.gltf.glb` is `banner`).
    Hidden files are left out (other systems leave `._name.obj` beside `name.obj`), and linked
    folders are not entered.

    Raises:
        TrilightError: a folder cannot be read, two files have the same uid, or a link leads out.
    """
    root = folder.resolve()
    records: dict[str, ObjectRecord] = {}
    for path in _object_files(root):
        shown = printable(path.relative_to(root).as_posix())
        if not path.resolve().is_relative_to(root):
            raise TrilightError(
                f"{shown}: is a link out of {printable(str(folder))}; expected files below it. "
                "Copy the file, or name the folder that holds it."
            )
        uid = _without_suffixes(shown)
        if uid in records:
            raise TrilightError(
                f"{shown}: has the uid {uid!r} of {printable(Path(records[uid].path).name)}; "
                f"expected one file per object. Rename one, or list the objects in objects.jsonl."
            )
        records[uid] = ObjectRecord(
            uid=uid,
            path=str(path),
            title=uid.rpartition("/")[2],
            licence=USER_PROVIDED,
            attribution="",
            source_url="",
        )
    return list(records.values())


def _object_files(root: Path) -> list[Path]:
    def stop(error: OSError) -> None:
        raise TrilightError(
            f"{printable(str(error.filename))}: cannot be read ({error.strerror}); expected a "
            "readable folder. Mend its permissions or move it away."
        )

    found = []
    for place, folders, files in os.walk(root, onerror=stop):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [
            Path(place, name)
            for name in files
            if not name.startswith(".") and name.lower().endswith(SUFFIXES)
        ]
    return sorted(found)


def _without_suffixes(name: str) -> str:
    while name.lower().endswith(SUFFIXES):
        name = name[: name.rindex(".")]
    return name
