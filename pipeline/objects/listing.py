"""What a source says that it holds, before a licence is judged and before anything is fetched."""

from collections.abc import Callable
from dataclasses import dataclass

from storage.records.objects import Failure, ObjectRecord

Fetched = tuple[list[ObjectRecord], list[Failure]]
CountDone = Callable[[int, int], None]


def _here_already(records: list[ObjectRecord], downloaded: CountDone) -> Fetched:
    return records, []


@dataclass(frozen=True, kw_only=True)
class Listing:
    """The objects of a source and how to get those of them that may be used."""

    records: list[ObjectRecord]
    """In any order. The path of an object that must be fetched means nothing yet."""
    failures: list[Failure]
    """Objects that cannot be used, whatever their licence."""
    fetch: Callable[[list[ObjectRecord], CountDone], Fetched] = _here_already
    """Brings objects to this machine; returns them with their paths, and a failure for each that
    could not be had. Files of this machine are left where they are."""


def failure(uid: str, reason: str, message: str) -> Failure:
    """Return the row of an object that this stage refuses."""
    return Failure(stage="objects", item=uid, reason=reason, message=message)
