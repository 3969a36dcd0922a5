"""Prepares the user's textures and environment maps, and freezes them with the objects.

Each file is decoded once, in a child with limits; the result is in the user's cache. The digest of
its content decides the split of a texture or map, by the rule of objects.
"""

import contextlib
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    ChildPool,
    IsolatedChild,
    call_with_retries,
    reach,
)
from pipeline.objects.listing import failure
from pipeline.objects.maps.listing import PLURALS, FoundMap, find_maps
from pipeline.objects.maps.prepared import decode_prepared, map_cache_key, prepare_map
from pipeline.presets.settings import DatasetSettings
from scene_templates.settings import SceneSettings
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.conventions import SPLITS
from storage.dataset.splits import split_of_object
from storage.digests import sha256_hex
from storage.errors import Rejected, TrilightError
from storage.records.objects import SKY, TEXTURE, Failure, LockedObject, failure_of
from storage.remote.safe_url import printable

log = logging.getLogger("trilight.maps")

_LIMITS = ChildLimits(memory_bytes=8 << 30, wall_s=600, cpu_s=300, calls_per_child=200)
"""The largest map, 8192 x 4096 in float32, takes 403 MB, and its mip levels six times as much."""


@dataclass(frozen=True, kw_only=True)
class AcceptedMaps:
    """The user's textures and environment maps that scenes may use."""

    rows: tuple[tuple[LockedObject, Path], ...] = ()
    """Every usable texture and map with its prepared file."""
    failures: tuple[Failure, ...] = ()
    """Reasons why other files cannot be used, or not fully."""


def map_folders(folders: Mapping[str, str | None], scenes: SceneSettings) -> Mapping[str, str]:
    """Return the folders of textures and maps that are given, by kind.

    Raises:
        TrilightError: a folder is given that no scene would use, or scenes need a folder that is
            not given.
    """
    for kind, drawn in ((TEXTURE, scenes.textures), (SKY, scenes.skies)):
        name = PLURALS[kind]
        is_used = bool(drawn.share and drawn.own_share)
        if folders[kind] is None and is_used:
            raise TrilightError(
                f"scenes.{name}.own_share is {drawn.own_share:g}, but --{name} is not given; "
                f"expected a folder. Add --{name} FOLDER, or --set scenes.{name}.own_share=0."
            )
        if folders[kind] is not None and not is_used:
            raise TrilightError(
                f"--{name} is given, but scenes.{name}.share is {drawn.share:g} and own_share "
                f"{drawn.own_share:g}; expected both above 0. Add --set scenes.{name}.share=0.5 "
                f"--set scenes.{name}.own_share=1, or leave --{name} out."
            )
    return {kind: folder for kind, folder in folders.items() if folder is not None}


def accept_maps(
    folders: Mapping[str, str], licence: str | None, settings: DatasetSettings, *, workers: int
) -> AcceptedMaps:
    """Prepare the textures and maps of folders.

    Args:
        folders: a folder by kind, TEXTURE or SKY.
        licence: licence that the user states for folders without a catalogue.
        workers: number of files that are decoded at the same time.

    Raises:
        TrilightError: a folder is missing or empty, none of its files can be used, or the cache
            cannot be written.
    """
    rows: list[tuple[LockedObject, Path]] = []
    failures: list[Failure] = []
    for kind, folder in folders.items():
        listing = find_maps(
            kind, folder, licence=licence, allowed_licences=settings.allowed_licences
        )
        outcomes = _prepare_maps(kind, listing.maps, settings, workers)
        usable = [outcome for outcome in outcomes if not isinstance(outcome, Failure)]
        failures += [
            failure(locked.uid, "not_read", notes.read_text("utf-8"))
            for locked, path in usable
            if (notes := _notes(path)).exists()
        ]
        lost = [outcome for outcome in outcomes if isinstance(outcome, Failure)]
        failures += [*listing.failures, *lost]
        if not usable:
            first = (*lost, *listing.failures)[0]
            raise TrilightError(
                f"{PLURALS[kind]}: none of {len(lost) + len(listing.failures)} files can be used; "
                f"the first is {first.item}: {first.reason} ({first.message}). Fix or replace it."
            )
        _warn_of_maps(kind, [locked for locked, _ in usable], lost)
        rows += usable
    return AcceptedMaps(rows=tuple(rows), failures=tuple(failures))


def _prepare_maps(
    kind: str, maps: Sequence[FoundMap], settings: DatasetSettings, workers: int
) -> list[tuple[LockedObject, Path] | Failure]:
    scenes = settings.scenes
    size = scenes.textures.surfaces.size if kind == TEXTURE else scenes.skies.maps.height
    all_files = reach(files=(path for user_map in maps for path in user_map.files.values()))

    def prepare(user_map: FoundMap) -> tuple[LockedObject, Path] | Failure:
        try:
            with pool.borrow() as child:
                path = _prepare_file(kind, user_map.files, size, child)
            data = path.read_bytes()
            content_sha256 = decode_prepared(data, path.name).content_sha256
        except Rejected as rejection:
            return failure_of("objects", user_map.record.uid, rejection)
        locked = LockedObject(
            **user_map.record.identity,
            asset_sha256=sha256_hex(data),
            split=split_of_object(content_sha256, settings.splits),
            kind=kind,
        )
        return locked, path

    children = ChildPool(lambda _: IsolatedChild(limits=_LIMITS, confined_to=all_files), workers)
    with contextlib.closing(children) as pool, ThreadPoolExecutor(workers) as threads:
        return list(threads.map(prepare, maps))


def _notes(prepared: Path) -> Path:
    """Return the path of the note on unread parts of a prepared file; absent if there are none."""
    return prepared.with_suffix(".txt")


def _prepare_file(kind: str, files: Mapping[str, Path], size: int, child: IsolatedChild) -> Path:
    """Prepare a file in a child unless the cache has it; return its path. Raises Rejected."""
    name = map_cache_key(kind, files, size)
    path = cache_folder("maps") / name[:2] / f"{name}.safetensors"
    if not path.exists():
        try:
            data, unread = call_with_retries(child, prepare_map, kind, files, size)
        except ChildFailed as failure:
            raise Rejected(failure.reason, failure.sentence) from failure
        if map_cache_key(kind, files, size) != name:
            raise Rejected("unreadable_file", "it changed while it was being prepared")
        if unread:
            message = printable(f"it is used without {'; '.join(unread)}")
            write_atomically(_notes(path), message.encode())
        write_atomically(path, data)
    return path


def _warn_of_maps(kind: str, locked: Sequence[LockedObject], lost: Sequence[Failure]) -> None:
    if lost:
        first = lost[0]
        log.warning(
            "%s: %d cannot be used, such as %s (%s: %s); failures.jsonl names all",
            PLURALS[kind],
            len(lost),
            first.item,
            first.reason,
            first.message,
        )
    without = [split for split in SPLITS if split not in {entry.split for entry in locked}]
    if without and {entry.split for entry in locked} != {"test"}:
        log.warning(
            "%s: of %d, none belongs to %s, whose scenes get procedural ones; about 30 different "
            "ones are enough for every split",
            PLURALS[kind],
            len(locked),
            " and ".join(without),
        )
