"""The listing of a source: its objects before the licence check, their uids, their downloads."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.foreign.limits import SUFFIXES
from storage.records.objects import Failure, ObjectRecord
from storage.remote.transfers import TransferFailed
from storage.remote.url import printable

Fetched = tuple[list[ObjectRecord], list[Failure]]
CountDone = Callable[[int, int], None]
THREADS = 8


@dataclass(frozen=True, kw_only=True)
class Listing:
    """The objects of a source, and the function that fetches them."""

    records: list[ObjectRecord]
    """Objects in any order; the path of an object that must be fetched has no meaning yet."""
    failures: list[Failure] = field(default_factory=list)
    """Objects that are unusable, whatever their licence."""
    fetch: Callable[[list[ObjectRecord], CountDone], Fetched] | None = None
    """Downloads objects; returns them with their paths, and a failure for each that could not be
    fetched. None where all files are on this machine."""


def failure(uid: str, reason: str, message: str) -> Failure:
    """Return the failure of an object that the stage `objects` refuses."""
    return Failure(stage="objects", item=uid, reason=reason, message=message)


def assign_uids(names: Iterable[str]) -> tuple[dict[str, str], list[Failure]]:
    """Return the uid of every file, and a failure for each file without a unique one.

    The uid is the path within the folder, made printable, without its suffixes: `banner.gltf.glb`
    is `banner`. Where an earlier name has that uid, it is the full name: `a.obj` and `a.stl` become
    `a` and `a.stl`. So a new file may take the uid of an older one that differs in its suffix only;
    a catalogue keeps uids fixed. Of two names that print alike (a line break, and a backslash with
    an n), the later one fails.
    """
    uids: dict[str, str] = {}
    failures = []
    taken: set[str] = set()
    for name in sorted(names):
        full = printable(name)
        short = full
        while short.lower().endswith(SUFFIXES):
            short = short[: short.rindex(".")]
        uid = full if short in taken or not short.rpartition("/")[2].strip() else short
        if uid in taken:
            message = "another file has a name that prints alike; rename one of them"
            failures.append(failure(uid, "name_clash", message))
            continue
        taken.add(uid)
        uids[name] = uid
    return uids, failures


def fetch_all(
    records: list[ObjectRecord],
    downloaded: CountDone,
    fetch: Callable[[ObjectRecord], Path],
    cancel: Callable[[], object] = lambda: None,
) -> Fetched:
    """Fetch every object; a TransferFailed of `fetch` is a failure of that object alone.

    Args:
        records: what to fetch.
        downloaded: called in this thread with the number of finished objects, failed ones
            included, and the total.
        fetch: returns the local path of a record's file; called in THREADS threads.
        cancel: called where the run ends early, so that `fetch` may give up.

    Raises:
        Exception: any other error of `fetch`; fetches that have not begun are cancelled.
    """
    fetched: list[ObjectRecord] = []
    failures: list[Failure] = []
    downloaded(0, len(records))
    with ThreadPoolExecutor(THREADS) as pool:
        waiting = {pool.submit(fetch, record): record for record in records}
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                try:
                    fetched.append(replace(waiting[future], path=str(future.result())))
                except TransferFailed as error:
                    failures.append(failure(waiting[future].uid, error.reason, error.message))
                downloaded(done, len(records))
        except BaseException:
            cancel()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return fetched, failures
