"""Object sources by the word before their colon, and the listing of one source.

Sources are folders, catalogues, servers, Objaverse and built-in objects. Nothing is loaded here: a
record names a file, and the mesh stage checks whether it is usable.
"""

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from pipeline.foreign.limits import SUFFIXES
from pipeline.objects.generated import generate_objects, num_builtin
from pipeline.objects.licences import (
    check_allowed,
    refuse_licences,
    require_unstated,
    stated_licence,
)
from pipeline.objects.listing import CountDone, Fetched, Listing
from pipeline.objects.local.folder import list_folder
from pipeline.objects.objaverse.source import list_objaverse
from pipeline.objects.remote.source import list_remote
from storage.aliases import OBJECTS, stored_name
from storage.cache import cache_folder
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from storage.registry import Registry
from storage.remote.url import PACKAGES, parse_url, printable, safe_url


@dataclass(frozen=True, kw_only=True)
class SourceQuery:
    """The options of one request to an object source."""

    source: str
    """The source as the user wrote it, such as `objaverse:category/chair`."""
    work_dir: Path
    """Folder for files that a source writes: in the dataset, or in the user's cache."""
    licence: str | None
    """Licence that the user states for files without a statement of their own."""
    allowed_licences: Sequence[str]
    """Licences on the allow-list, for sources that skip refused objects; a later check is final."""

    @property
    def after_colon(self) -> str:
        """The part of `source` after the first colon."""
        return self.source.partition(":")[2]


@dataclass(frozen=True, kw_only=True)
class ObjectSource:
    """A source of objects, registered under the word before its colon."""

    list: Callable[[SourceQuery], Listing]
    """Returns the source's listing; raises TrilightError where it is missing or malformed."""
    look: Callable[[SourceQuery], object] | None = None
    """Raises the errors of `list` without its cost, and writes nothing; None where `list` is cheap.
    """
    states_licences: bool = True
    """True where the source states the licence of every object; `--licence` is then refused."""
    is_place: bool = False
    """True where the name is the scheme of a URL, which may hold a secret."""


def _list_folder(query: SourceQuery) -> Listing:
    location = parse_url(query.source, what="objects")
    if isinstance(location, Path):
        return list_folder(location, query.licence)
    return list_remote(location, query.licence)


FOLDER_SOURCE = ObjectSource(list=_list_folder, states_licences=False, is_place=True)
"""A folder, local or on a server; also every source without a known name before a colon."""

SOURCES: Registry[ObjectSource] = Registry(
    "object source",
    ObjectSource,
    {
        "builtin": ObjectSource(
            list=lambda query: Listing(records=generate_objects(query.source, query.work_dir)),
            look=lambda query: num_builtin(query.source),
        ),
        "objaverse": ObjectSource(
            list=lambda query: list_objaverse(query.source, query.allowed_licences)
        ),
        **dict.fromkeys(("file", *PACKAGES, "pipe", "env"), FOLDER_SOURCE),
    },
    decides=("data",),
)
"""Object sources by the word before the colon."""


ENVIRONMENT = "env:"
"""Prefix of a source that stands in an environment variable, for URLs with a secret."""
VARIABLES = "TRILIGHT_SOURCE_"
"""Prefix of allowed variables, so that starting a run cannot reveal any other."""

_QUOTED = re.compile(r"^objects (?:is )?(?:'[^']*'|\"[^\"]*\")")
"""Beginning of messages about a source."""
_WORD = re.compile(r"\w{3,}")
_DOWNLOAD_REASONS = ("download_failed", "too_large_bytes", "too_many_buffers", "unsafe_name")


@dataclass(frozen=True, kw_only=True, eq=False)
class ListedObjects(Listing):
    """The objects of a source with an allowed licence; `failures` holds all others."""

    source: str
    """The source as the user wrote it."""

    def fetch_selected(
        self,
        is_selected: Callable[[str], bool] = lambda uid: True,
        downloaded: CountDone = lambda done, total: None,
    ) -> Listing:
        """Download the selected objects of allowed licences; return them with the failures.

        Downloads stay in the user's cache (`storage.cache`; Objaverse in the folder of its
        package) and are not repeated.

        Args:
            is_selected: returns True for the uid of a selected object.
            downloaded: called with the number of finished downloads, failed ones included, and the
                total; from the calling thread.

        Returns:
            Objects whose files are on this machine, and failures of the stage `objects`, both
            sorted by uid: licence_refused, download_failed, too_large_bytes, too_many_buffers,
            unsafe_name, unknown_uid, link_outside, name_clash.

        Raises:
            TrilightError: none of the selected objects could be downloaded.
        """
        records = [record for record in self.records if is_selected(record.uid)]
        failures = [failure for failure in self.failures if is_selected(failure.item)]
        if self.fetch is not None:
            records, lost = self.fetch(records, downloaded)
            failures += lost
        self.require_some(len(records), failures)
        return Listing(
            records=sorted(records, key=attrgetter("uid")),
            failures=sorted(failures, key=attrgetter("item")),
        )

    def require_some(self, num_here: int, failures: Sequence[Failure]) -> None:
        """Raise TrilightError where downloads were tried and all failed."""
        lost = [failure for failure in failures if failure.reason in _DOWNLOAD_REASONS]
        if num_here or not lost:
            return
        first = min(lost, key=attrgetter("item"))
        with _resolve_source(self.source) as value:
            raise TrilightError(
                f"objects {printable(safe_url(value))!r}: none of {len(lost)} objects could be "
                f"downloaded; the first is {first.reason} ({first.message}); expected at least "
                "one. Check the source and try again."
            )


def list_objects(
    source: str,
    *,
    work_dir: Path,
    allowed_licences: Sequence[str],
    licence: str | None = None,
) -> ListedObjects:
    """List a source; the licence check of an object comes before its download.

    Args:
        source: a folder; `http(s)://`, `s3://`, `gs://`, `hf://` or `file://` and a folder;
            `procedural:` or `procedural:N`; `objaverse:` and uids, a file of uids, or categories. A
            folder lists the rows of its `objects.jsonl` or `objects.csv`, or else its object
            files. `env:NAME` is the content of the environment variable NAME, which no message
            quotes; NAME begins with VARIABLES.
        work_dir: folder for built-in objects; untouched for other sources.
        allowed_licences: SPDX identifiers, `LicenseRef-...`, or whole compound expressions.
        licence: the user's licence for files without a statement.

    Raises:
        TrilightError: the source is malformed, missing or empty; its catalogue has a mistake; a
            licence identifier is malformed, or is stated where the source states its own; a package
            is missing, or a server does not answer.
    """
    source = stored_name(source, OBJECTS)
    with _resolve_source(source) as value:
        listing = _list_some(*_choose_source(value, work_dir, licence, allowed_licences))
    allowed, refused = refuse_licences(listing.records, allowed_licences)
    fetch = listing.fetch

    def fetch_resolved(records: list[ObjectRecord], downloaded: CountDone) -> Fetched:
        assert fetch is not None
        with _resolve_source(source):
            return fetch(records, downloaded)

    return ListedObjects(
        source=source,
        records=allowed,
        failures=[*listing.failures, *refused],
        fetch=None if fetch is None else fetch_resolved,
    )


def check_source(source: str, *, allowed_licences: Sequence[str], licence: str | None) -> None:
    """Check that a source exists and holds an object, before a dataset of it begins.

    Only the user's cache is written.

    Raises:
        TrilightError: as `list_objects`.
    """
    with _resolve_source(source) as value:
        folder = cache_folder("objects")
        kind, query = _choose_source(value, folder, licence, allowed_licences)
        if kind.look is not None:
            kind.look(query)
        else:
            _list_some(kind, query)


@contextlib.contextmanager
def _resolve_source(source: str) -> Iterator[str]:
    """Yield the source, or its environment variable's content, hidden from error messages."""
    value = _read_variable(source)
    try:
        yield value
    except TrilightError as mistake:
        if value == source:
            raise
        raise type(mistake)(_redact_value(str(mistake), source, value)) from None


def _read_variable(source: str) -> str:
    """Return the source, or the content of the environment variable that it names."""
    if not source.startswith(ENVIRONMENT):
        return source
    name = source.removeprefix(ENVIRONMENT)
    label = printable(source)
    if not name.startswith(VARIABLES):
        raise TrilightError(
            f"objects {label!r} names a variable that is not for sources; expected one whose name "
            f"begins with {VARIABLES}. Set the source under such a name."
        )
    if not (value := os.environ.get(name)):
        raise TrilightError(
            f"objects {label!r}: the environment variable {printable(name)!r} is not set here; "
            "expected it to name a source of objects."
        )
    return value


def _redact_value(message: str, source: str, value: str) -> str:
    """Return a message about a source with the variable's name instead of its content."""
    label = f"objects {printable(source)!r}"
    redacted = _QUOTED.sub(lambda _: label, message)
    rest = redacted.removeprefix(label)
    if rest != redacted and not any(word in rest for word in _WORD.findall(value)):
        return redacted
    return (
        f"{label} cannot be used as what it says; expected a source of objects. Name that source "
        "itself in a terminal of this machine to see the error: trilight assets SOURCE."
    )


def _choose_source(
    source: str, work_dir: Path, licence: str | None, allowed_licences: Sequence[str]
) -> tuple[ObjectSource, SourceQuery]:
    """Return a source with its query; raises TrilightError for licences that cannot be."""
    check_allowed(allowed_licences)
    stated_licence(licence)
    name, colon, _ = source.partition(":")
    kind = SOURCES.get(name, FOLDER_SOURCE) if colon else FOLDER_SOURCE
    if kind.states_licences:
        require_unstated(licence, f"{name}:")
    return kind, SourceQuery(
        source=source, work_dir=work_dir, licence=licence, allowed_licences=allowed_licences
    )


def _list_some(kind: ObjectSource, query: SourceQuery) -> Listing:
    """Return the listing of a source; raises TrilightError where it is invalid or empty."""
    listing = kind.list(query)
    if not listing.records and not listing.failures:
        raise TrilightError(
            f"objects {printable(safe_url(query.source))!r} holds no object; expected "
            f"{' '.join(SUFFIXES)} files, or a catalogue (objects.jsonl or objects.csv) that lists "
            "some. Name procedural: for built-in objects."
        )
    return listing
