"""Shards of planned samples: opened ahead of their first read, closed after the last."""

import threading
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from storage.dataset.shard_set import OpenShard, ShardSet

OPENED_AT_ONCE = 4
"""Maximum number of shards that are fetched and checked at the same time."""


class OpenShards:
    """Open shards of a set, by number. Safe to use from several threads."""

    def __init__(self, shards: ShardSet) -> None:
        self._shards = shards
        self._opening = ThreadPoolExecutor(OPENED_AT_ONCE, thread_name_prefix="open-shard")
        self._open: dict[int, Future[OpenShard]] = {}
        self._planned: Counter[int] = Counter()
        self._lock = threading.Lock()

    def __enter__(self) -> "OpenShards":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close all shards; wait for those being opened, whose files must not be left open."""
        self._opening.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            for future in self._open.values():
                _close(future)
            self._open.clear()

    def plan(self, numbers: Iterable[int]) -> None:
        """Start to open the shards of planned samples: one shard number for each sample."""
        with self._lock:
            for number in numbers:
                self._planned[number] += 1
                if number not in self._open:
                    self._open[number] = self._opening.submit(self._shards.open, number)

    def read(self, number: int) -> OpenShard:
        """Return a planned shard after it is open; raises the error of opening it."""
        with self._lock:
            future = self._open[number]
        return future.result()

    def mark_read(self, numbers: Iterable[int]) -> None:
        """Mark samples as read: one shard number for each, as planned."""
        with self._lock:
            self._planned.subtract(numbers)
            for number in [number for number, count in self._planned.items() if not count]:
                del self._planned[number]
                self._open.pop(number).add_done_callback(_close)


def _close(future: Future[OpenShard]) -> None:
    if not future.cancel() and future.exception() is None:
        future.result().close()
