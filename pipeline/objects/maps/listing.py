"""Folders of textures and of environment maps: what they hold, and whose it is.

A folder has a catalogue, as a folder of objects may have one, or else all of its pictures count.
Nothing is decoded here. The uid of a texture or map begins with its kind, so that it is no
object's.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

from pipeline.objects.licences import (
    StatedLicence,
    refuse_licences,
    require_unstated,
    stated_licence,
)
from pipeline.objects.listing import failure
from pipeline.objects.local.catalogue import read_catalogue
from pipeline.objects.maps.names import NO_TEXTURE, PICTURES, named_part, sets_of
from storage.errors import TrilightError
from storage.records.objects import SKY, TEXTURE, Failure, ObjectRecord
from storage.remote.safe_url import printable

SUFFIXES = {TEXTURE: PICTURES, SKY: (".exr", ".hdr")}
"""Of the files of each kind, compared in lower case."""

PLURALS = {TEXTURE: "textures", SKY: "skies"}
"""What folders and catalogues of each kind are called."""


@dataclass(frozen=True, kw_only=True)
class FoundMap:
    """A texture or a map that may be used."""

    record: ObjectRecord
    """Identity and rights."""
    files: Mapping[str, Path]
    """Its pictures by part (pipeline.objects.maps.names); a map has one, "map"."""


@dataclass(frozen=True, kw_only=True)
class FoundMaps:
    """What a folder of textures or maps has to offer."""

    maps: tuple[FoundMap, ...]
    """Those with an allowed licence, sorted by uid."""
    failures: tuple[Failure, ...]
    """The other files, of the stage `objects`: licence_refused, no_base_colour, map_not_used,
    name_clash, link_outside."""


def find_maps(
    kind: str, folder: str, *, licence: str | None, allowed_licences: Sequence[str]
) -> FoundMaps:
    """Return the textures or maps of a folder of this machine that may be used.

    Args:
        kind: TEXTURE or SKY.
        folder: with a catalogue `textures.jsonl` or `.csv` (`skies.jsonl` or `.csv`), whose rows
            are those of a catalogue of objects and name base colours; otherwise all pictures below
            it count, each under the licence that the user states.
        licence: of files without a catalogue; by default they are the user's own.
        allowed_licences: SPDX identifiers, `LicenseRef-...`, or compound expressions.

    Raises:
        TrilightError: the folder is missing or holds nothing, or its catalogue has a mistake.
    """
    root, shown, plural = Path(os.path.realpath(folder)), printable(folder), PLURALS[kind]
    suffixes = " ".join(SUFFIXES[kind])
    if "://" in folder or not root.is_dir():
        raise TrilightError(
            f"{plural} {shown!r}: no such folder on this machine; expected one with {suffixes} "
            "files. Download them first where they are on a server."
        )
    stated, catalogue = stated_licence(licence), _only_catalogue(root, plural)
    failures: list[Failure] = []
    if catalogue is None:
        records = _scanned(kind, root, stated, failures)
    else:
        require_unstated(licence, catalogue.name)
        records = [replace(row, uid=f"{kind}:{row.uid}") for row in read_catalogue(catalogue)]
    if not records and not failures:
        raise TrilightError(
            f"{plural} {shown!r} holds none; expected {suffixes} files, or a catalogue "
            f"{plural}.csv that lists some."
        )
    allowed, refused = refuse_licences(records, allowed_licences)
    return FoundMaps(
        maps=tuple(_with_files(kind, root, sorted(allowed, key=attrgetter("uid")))),
        failures=tuple(sorted([*failures, *refused], key=attrgetter("item"))),
    )


def _only_catalogue(root: Path, plural: str) -> Path | None:
    found = [path for end in ("jsonl", "csv") if (path := root / f"{plural}.{end}").exists()]
    if len(found) > 1:
        raise TrilightError(
            f"{plural}: the folder has {found[0].name} and {found[1].name}; expected one "
            "catalogue. Remove one."
        )
    return found[0] if found else None


def _with_files(kind: str, root: Path, records: Sequence[ObjectRecord]) -> list[FoundMap]:
    """Return records with their files; those beside a base colour that belong to it come too.

    Links out of the folder do not.
    """
    sets: dict[Path, dict[str, dict[str, Path]]] = {}
    found = []
    for record in records:
        path = Path(record.path)
        files = {"base" if kind == TEXTURE else "map": path}
        if kind == TEXTURE and path.parent.is_dir():
            if path.parent not in sets:
                sets[path.parent] = sets_of(path.parent)
            beside = sets[path.parent].get(named_part(path.stem)[0], {})
            files = {
                part: at
                for part, at in beside.items()
                if part not in NO_TEXTURE and _is_below(root, at)
            } | files
        found.append(FoundMap(record=record, files=files))
    return found


def _scanned(
    kind: str, root: Path, stated: StatedLicence, failures: list[Failure]
) -> list[ObjectRecord]:
    """Return a record of each set of textures, or of each map, and add what is no part of one."""
    names = _files(root, SUFFIXES[kind])
    parts = {name: _named(kind, name.rpartition(".")[0]) for name in names}
    begun = {stem for stem, part in parts.values() if part == "base"}
    records: dict[str, ObjectRecord] = {}
    for name, (stem, part) in parts.items():
        uid, item = f"{kind}:{printable(stem)}", f"{kind}:{printable(name)}"
        if not _is_below(root, root / name):
            message = "it is a link out of the folder; copy the file into it"
            failures.append(failure(item, "link_outside", message))
        elif part in NO_TEXTURE:
            message = f"it is a map of {part}; expected colours, metallic and roughness"
            failures.append(failure(item, "map_not_used", message))
        elif part != "base":
            if stem not in begun:
                message = f"it is the {part} of {stem}, which has no base colour; add or rename it"
                failures.append(failure(item, "no_base_colour", printable(message)))
        elif uid in records:
            message = "another file of the same name is taken; rename one of them"
            failures.append(failure(item, "name_clash", message))
        else:
            records[uid] = _record(uid, root / name, stated)
    return list(records.values())


def _is_below(root: Path, path: Path) -> bool:
    """Return whether a file is in a folder, wherever links lead; for links in a circle too."""
    return Path(os.path.realpath(path)).is_relative_to(root)


def _named(kind: str, stem: str) -> tuple[str, str]:
    return named_part(stem) if kind == TEXTURE else (stem, "base")


def _record(uid: str, path: Path, stated: StatedLicence) -> ObjectRecord:
    return ObjectRecord(
        uid=uid,
        path=str(path),
        title=uid.partition(":")[2].rpartition("/")[2],
        licence=stated.licence,
        licence_source=stated.licence_source,
        attribution="",
        source_url="",
    )


def _files(root: Path, suffixes: tuple[str, ...]) -> list[str]:
    """Return the paths of the files with a suffix relative to `root`, none of them hidden."""

    def stop(error: OSError) -> None:
        raise TrilightError(
            f"{printable(str(error.filename))}: cannot be read ({error.strerror}); expected a "
            "readable folder. Mend its permissions or move it away."
        )

    found: list[str] = []
    for place, folders, files in os.walk(root, onerror=stop):
        folders[:] = [name for name in folders if not name.startswith(".")]
        inner = Path(place).relative_to(root)
        found += [
            (inner / name).as_posix()
            for name in files
            if name.lower().endswith(suffixes) and not name.startswith(".")
        ]
    return sorted(found)
