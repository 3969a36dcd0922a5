"""Claims in a bucket: files that the server creates once, by which machines share work.

As in a folder (storage.claims), a claim only avoids that work is done twice. A bucket does not see
that a machine dies: a claim that a worker has seen for `LEASE_S` counts as that of a dead machine,
and the next claim on the same work may be made.
"""

import contextlib
import functools
import itertools
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from storage.atomic import write_atomically
from storage.claims import hold_claim
from storage.errors import TrilightError
from storage.remote.bucket import Bucket

LEASE_S = 900.0
"""Longest time that a claim keeps others off, s; work that takes longer is done twice."""
_FREE = b"free"


class BucketClaims:
    """The claims of one machine."""

    def __init__(self, bucket: Bucket, worker: Path) -> None:
        """Remember where claims are.

        Args:
            bucket: the bucket that the machines share.
            worker: file with the name of this machine, written at its first claim. A machine that
                is killed has its claims again at once.
        """
        self._bucket = bucket
        self._worker_file = worker
        self._first_seen: dict[str, float] = {}

    @contextlib.contextmanager
    def hold_claim(self, name: str) -> Iterator[bool]:
        """Hold the claim on a file for the block; yield whether it is ours.

        Only one process of a machine may ask for the same claim at a time.

        Raises:
            TrilightError: as `Bucket.create`.
        """
        claim = self._create(name)
        try:
            yield claim is not None
        finally:
            if claim is not None:
                self._free(claim)

    def _free(self, claim: str) -> None:
        with contextlib.suppress(TrilightError):  # the lease ends it
            self._bucket.write(claim, _FREE)

    def _create(self, name: str) -> str | None:
        """Return the file of our claim, or None where another machine holds one."""
        for number in itertools.count():
            claim = f"{name}.claim-{number}"
            if self._bucket.create(claim, self._worker):
                return claim
            holder = self._bucket.read_start(claim, len(self._worker))
            if holder == self._worker:
                return claim
            seen_s = time.monotonic() - self._first_seen.setdefault(claim, time.monotonic())
            if holder != _FREE and seen_s < LEASE_S:
                break
        return None

    @functools.cached_property
    def _worker(self) -> bytes:
        path = self._worker_file
        with hold_claim(
            path.with_suffix(".claim"), wait=True
        ):  # other processes are the same worker
            if not path.exists():
                write_atomically(path, uuid.uuid4().hex.encode())
        return path.read_bytes()
