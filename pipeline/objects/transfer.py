"""Fetching many things that may each fail, a few at a time."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed

from pipeline.objects.listing import CountDone, Fetched, failure
from storage.records.objects import Failure, ObjectRecord
from storage.remote.tries import TransferFailed


def fetch_all(
    records: list[ObjectRecord],
    fetch: Callable[[ObjectRecord], ObjectRecord],
    downloaded: CountDone,
    *,
    threads: int,
    stop: threading.Event,
) -> Fetched:
    """Fetch every object; a TransferFailed of `fetch` is a failure of that object alone.

    Args:
        records: what to fetch.
        fetch: returns the record with its path; called in threads, at most `threads` at a time.
        downloaded: called in this thread with how many are done, failed ones included, and with
            how many there are.
        threads: at least 1.
        stop: set where the run ends early, so that `fetch` may give up.

    Raises:
        Exception: whatever else `fetch` raises; what has not begun by then is left out.
    """
    here: list[ObjectRecord] = []
    failures: list[Failure] = []
    downloaded(0, len(records))
    with ThreadPoolExecutor(threads) as pool:
        waiting = {pool.submit(fetch, record): record for record in records}
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                try:
                    here.append(future.result())
                except TransferFailed as error:
                    failures.append(failure(waiting[future].uid, error.reason, error.message))
                downloaded(done, len(records))
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return here, failures
