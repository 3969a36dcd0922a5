"""Where objects come from, as one list of records: folders, catalogues, servers, Objaverse, ours.

Nothing is loaded here: a record names a file, and the mesh stage finds out whether it is any good.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from pipeline.objects.generated import PREFIX as BUILTIN
from pipeline.objects.generated import generate_objects, num_builtin
from pipeline.objects.licences import (
    check_allowed,
    refuse_licences,
    require_unstated,
    stated_licence,
)
from pipeline.objects.listing import Listing
from pipeline.objects.local.source import list_folder
from pipeline.objects.objaverse.source import PREFIX as OBJAVERSE
from pipeline.objects.objaverse.source import list_objaverse
from pipeline.objects.remote.source import list_remote
from pipeline.objects.uids import SUFFIXES
from storage.errors import TrilightError
from storage.records import Failure, ObjectRecord
from storage.remote.url import parse_url
from storage.safe_url import printable, safe_url

ENVIRONMENT = "env:"
"""Begins a source that names an environment variable: the way for URLs that hold a secret."""

_NOT_HAD = ("download_failed", "too_large_bytes", "too_many_buffers", "unsafe_name")


@dataclass(frozen=True, kw_only=True)
class FoundObjects:
    """What a source has to offer."""

    records: tuple[ObjectRecord, ...]
    """Objects with an allowed licence whose files are on this machine, sorted by uid."""
    failures: tuple[Failure, ...]
    """The other ones, of the stage `objects`, sorted by uid: licence_refused, download_failed,
    too_large_bytes, too_many_buffers, unsafe_name, unknown_uid, link_outside, name_clash."""

    @property
    def num_found(self) -> int:
        """How many objects the source has."""
        return len(self.records) + len(self.failures)


def _silent(done: int, total: int) -> None:
    """Show no progress."""


def find_objects(
    source: str,
    *,
    work_dir: Path,
    allowed_licences: Sequence[str],
    licence: str | None = None,
    downloaded: Callable[[int, int], None] = _silent,
) -> FoundObjects:
    """Return the objects of a source that may be used, after bringing them to this machine.

    The licence of an object is judged before it is downloaded. What is downloaded stays in the
    user's cache (`storage.cache`; Objaverse in the place of its own package), and is not
    downloaded again.

    Args:
        source: a folder; `http(s)://`, `s3://`, `gs://`, `hf://` or `file://` and a folder;
            `builtin:` or `builtin:N`; `objaverse:` and uids, a file of uids, or categories. Of a
            folder, `objects.jsonl` or `objects.csv` is used where it has one, and its object
            files otherwise. `env:NAME` is what the environment variable NAME says.
        work_dir: where built-in objects are written; not touched for other sources.
        allowed_licences: SPDX identifiers, `LicenseRef-...`, or compound expressions as they stand.
        licence: of files that come without any statement, as the user states it.
        downloaded: called with how many downloads are done, failed ones included, and with how
            many there are; from the calling thread.

    Raises:
        TrilightError: the source is malformed, missing or empty; its catalogue has a mistake; a
            licence has no form of one, or is stated where the source states its own; a package is
            missing; a server does not answer, or nothing could be downloaded.
    """
    source = _from_environment(source)
    listing = _listed(source, work_dir, licence, allowed_licences)
    shown = printable(safe_url(source))
    allowed, refused = refuse_licences(listing.records, allowed_licences)
    here, lost = listing.fetch(allowed, downloaded)
    failures = [*listing.failures, *refused, *lost]
    _require_some(shown, here, failures)
    return FoundObjects(
        records=tuple(sorted(here, key=attrgetter("uid"))),
        failures=tuple(sorted(failures, key=attrgetter("item"))),
    )


def look_at_source(source: str, *, allowed_licences: Sequence[str], licence: str | None) -> None:
    """Find out whether a source is there and holds anything, before a dataset of it is begun.

    Nothing is written beside what a server's listing leaves in the cache.

    Raises:
        TrilightError: as `find_objects`, as far as listing the source tells.
    """
    source = _from_environment(source)
    if source.startswith(BUILTIN):
        require_unstated(licence, BUILTIN)
        num_builtin(source)
    else:
        _listed(source, Path(), licence, allowed_licences)


def _from_environment(source: str) -> str:
    if not source.startswith(ENVIRONMENT):
        return source
    name = source.removeprefix(ENVIRONMENT)
    if not (found := os.environ.get(name)):
        raise TrilightError(
            f"objects {printable(source)!r}: the environment variable {printable(name)!r} is not "
            "set here; expected it to name a source of objects."
        )
    return found


def _listed(
    source: str, work_dir: Path, licence: str | None, allowed_licences: Sequence[str]
) -> Listing:
    """Return what a source says that it holds; raises TrilightError where that is nothing."""
    check_allowed(allowed_licences)
    stated_licence(licence)
    listing = _list(source, work_dir, licence, allowed_licences)
    if not listing.records and not listing.failures:
        raise TrilightError(
            f"objects {printable(safe_url(source))!r} holds no object; expected "
            f"{' '.join(SUFFIXES)} files, or a catalogue (objects.jsonl or objects.csv) that lists "
            f"some. Name {BUILTIN} for built-in objects."
        )
    return listing


def _list(
    source: str, work_dir: Path, licence: str | None, allowed_licences: Sequence[str]
) -> Listing:
    if source.startswith(BUILTIN):
        require_unstated(licence, BUILTIN)
        return Listing(records=generate_objects(source, work_dir), failures=[])
    if source.startswith(OBJAVERSE):
        require_unstated(licence, OBJAVERSE)
        return list_objaverse(source, allowed_licences)
    place = parse_url(source, what="objects")
    if isinstance(place, Path):
        return list_folder(place, licence)
    return list_remote(place, licence)


def _require_some(shown: str, here: list[ObjectRecord], failures: list[Failure]) -> None:
    """Raise TrilightError where downloads were tried and none came through."""
    lost = [failure for failure in failures if failure.reason in _NOT_HAD]
    if lost and not here:
        first = min(lost, key=attrgetter("item"))
        raise TrilightError(
            f"objects {shown!r}: none of {len(lost)} objects could be downloaded; the first is "
            f"{first.reason} ({first.message}); expected at least one. Check the source and try "
            "again."
        )
