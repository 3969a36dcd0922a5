"""Textures or environment maps (HDRIs) of a folder, with their rights.

A folder has a catalogue, as a folder of objects may have one, or else all of its pictures count.
Nothing is decoded here. The uid of a texture or map begins with its kind, so that it differs from
every object's.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

from pipeline.objects.file_filters import drop_outputs
from pipeline.objects.licences import refuse_licences, stated_licence
from pipeline.objects.listing import failure
from pipeline.objects.local.folder import (
    file_record,
    is_below,
    only_catalogue,
    read_catalogue,
    walk_files,
)
from pipeline.objects.maps.texture_names import PICTURES, group_textures, is_part_folder
from storage.errors import TrilightError
from storage.records.objects import SKY, TEXTURE, Failure, ObjectRecord
from storage.remote.url import printable

SUFFIXES = {TEXTURE: PICTURES, SKY: (".exr", ".hdr", ".pic")}
"""Suffixes of the files of each kind, compared in lower case."""

_UNREAD = {
    TEXTURE: "hdr psd psb dds ktx ktx2 tx jp2 j2k avif heic jxl gif svg sbsar zip 7z rar".split(),
    SKY: "png jpg jpeg tif tiff webp tga bmp psd dds ktx ktx2 tx jxl avif heic zip 7z rar".split(),
}
"""Suffixes of pictures in other formats, and of archives that may hold some."""

PLURALS = {TEXTURE: "textures", SKY: "skies"}
"""Names of folders and catalogues of each kind."""


@dataclass(frozen=True, kw_only=True)
class FoundMap:
    """A texture or map with an allowed licence."""

    record: ObjectRecord
    """Identity and rights of the texture or map."""
    files: Mapping[str, Path]
    """Picture files by component (pipeline.objects.maps.texture_names); a map has one, "map"."""


def find_maps(
    kind: str, folder: str, *, licence: str | None, allowed_licences: Sequence[str]
) -> tuple[list[FoundMap], list[Failure]]:
    """Return the usable textures or maps of a local folder, and the failures of its other files.

    Args:
        kind: TEXTURE or SKY.
        folder: with a catalogue `textures.jsonl` or `.csv` (`skies.jsonl` or `.csv`), whose rows
            are as in a catalogue of objects and name base colors; otherwise all pictures below
            it count, each under the user's licence.
        licence: licence of files without a catalogue; by default user-provided.
        allowed_licences: SPDX identifiers, `LicenseRef-...`, or compound expressions.

    Returns:
        Textures or maps with an allowed licence, sorted by uid, and failures of the stage
        `objects`: licence_refused, no_base_colour, map_not_used, unknown_map, unread_format,
        name_clash, link_outside.

    Raises:
        TrilightError: the folder is missing or holds nothing, or its catalogue has a mistake.
    """
    root = Path(os.path.realpath(folder))
    display_path = printable(folder)
    plural = PLURALS[kind]
    suffixes = " ".join(SUFFIXES[kind])
    if "://" in folder or not root.is_dir():
        raise TrilightError(
            f"{plural} {display_path!r}: no such folder on this machine; expected one with "
            f"{suffixes} files. Download them first where they are on a server."
        )
    stated = stated_licence(licence)
    catalogue = only_catalogue(lambda name: (root / name).exists(), licence, plural)
    failures: list[Failure] = []
    if catalogue is None:
        records = _scan_pictures(kind, root, stated, failures)
    else:
        rows = read_catalogue(root / catalogue)
        records = [replace(row, uid=f"{kind}:{row.uid}") for row in rows]
    if not records and not failures:
        raise TrilightError(
            f"{plural} {display_path!r} holds none; expected {suffixes} files, or a catalogue "
            f"{plural}.csv that lists some."
        )
    allowed, refused = refuse_licences(records, allowed_licences)
    maps = _with_files(kind, root, sorted(allowed, key=attrgetter("uid")))
    return maps, sorted([*failures, *refused], key=attrgetter("item"))


def _with_files(kind: str, root: Path, records: Sequence[ObjectRecord]) -> list[FoundMap]:
    """Return records with their files, and the files that belong to each base color.

    Links out of the folder are left out.
    """
    if kind == SKY:
        return [FoundMap(record=row, files={"map": Path(row.path)}) for row in records]
    textures: dict[str, dict[str, str]] = {}
    for folder in sorted(filter(Path.is_dir, {Path(row.path).parent for row in records})):
        folders = [folder]
        if folder != root and is_part_folder(folder.name):
            folders = [each for each in folder.parent.iterdir() if is_part_folder(each.name)]
        paths = [path for each in folders if each.is_dir() for path in each.iterdir()]
        names = [path.relative_to(root).as_posix() for path in paths]
        pictures = [n for n in names if n.lower().endswith(PICTURES) and not _is_hidden(n)]
        for files in group_textures(pictures)[0].values():
            textures[files["base"]] = files
    maps = []
    for row in records:
        base = Path(row.path)
        files = textures.get(base.relative_to(root).as_posix(), {})
        companions = {
            part: root / name for part, name in files.items() if is_below(root, root / name)
        }
        maps.append(FoundMap(record=row, files={**companions, "base": base}))
    return maps


def _scan_pictures(
    kind: str, root: Path, stated: Mapping[str, str], failures: list[Failure]
) -> list[ObjectRecord]:
    """Return a record of each texture or map, and add a failure for each other picture."""
    every = [name for name in drop_outputs(walk_files(root)) if not _is_hidden(name)]
    pictures = sorted(name for name in every if name.lower().endswith(SUFFIXES[kind]))
    names = [name for name in pictures if is_below(root, root / name)]
    unused = {
        name: ("unread_format", f"expected {' '.join(SUFFIXES[kind])}; convert or unpack it")
        for name in every
        if name.lower().rpartition(".")[2] in _UNREAD[kind]
    }
    message = "it is a link out of the folder; copy the file into it"
    unused |= dict.fromkeys(sorted({*pictures} - {*names}), ("link_outside", message))
    bases = [(name.rpartition(".")[0], name) for name in names]
    if kind == TEXTURE:
        textures, unused_pictures = group_textures(names)
        bases = [(stem, files["base"]) for stem, files in textures.items()]
        unused |= unused_pictures
    records: dict[str, ObjectRecord] = {}
    for stem, name in bases:
        title = printable(stem).rpartition("/")[2]
        record = file_record(
            f"{kind}:{printable(stem)}", {**stated, "path": str(root / name), "title": title}
        )
        if records.setdefault(record.uid, record) is not record:
            message = "another file of the same name is taken; rename one of them"
            unused[name] = ("name_clash", message)
    failures += [
        failure(f"{kind}:{printable(name)}", reason, printable(message))
        for name, (reason, message) in unused.items()
    ]
    return list(records.values())


def _is_hidden(name: str) -> bool:
    return name.rpartition("/")[2].startswith(".")
