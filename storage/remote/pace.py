"""How slow a transfer may be: a stalled server, or one that trickles, holds nobody for days."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from storage.remote.tries import TransferFailed


@dataclass(frozen=True, kw_only=True)
class Patience:
    """How long a file is waited for."""

    least_bytes_per_s: float = 10_000.0
    """Mean rate below which a transfer ends: a shard of 100 MB would take three hours. The slowest
    links that people work over, mobile ones at the edge of a cell, give twice that."""
    window_s: float = 300.0
    """Seconds over which the mean is taken; a link may be gone for nearly as long."""
    file_s: float = 86_400.0
    """Seconds for all of one file, tries and beginnings anew included: a day, in which the least
    rate brings 864 MB."""


PATIENCE = Patience()


class Pace:
    """Watches one file on its way, over all tries."""

    def __init__(
        self, position: Callable[[], int], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin to watch.

        Args:
            position: how many bytes have come; falls where a transfer begins anew.
            clock: seconds.
        """
        self._position = position
        self._clock = clock
        self._patience = PATIENCE
        self._begun = self._window = self._tried = (clock(), position())

    def require(self) -> None:
        """Raise TransferFailed where the file comes too slowly, or took too long altogether.

        To be called at every arrival and after every try: what is slow ends within two windows.
        """
        now_s, reached = self._clock(), self._position()
        if now_s - self._begun[0] > self._patience.file_s:
            message = f"it did not come within {self._patience.file_s:.0f} s"
            raise TransferFailed("download_failed", message)
        passed_s, moved = now_s - self._window[0], reached - self._window[1]
        if passed_s < self._patience.window_s:
            return
        if moved < self._patience.least_bytes_per_s * passed_s:
            raise TransferFailed(
                "download_failed",
                f"it is too slow, {max(moved, 0)} bytes in {passed_s:.0f} s; expected at least "
                f"{self._patience.least_bytes_per_s:.0f} a second",
            )
        self._window = (now_s, reached)

    def has_moved_on(self) -> bool:
        """Return whether the file came at the least rate since this was asked last."""
        before_s, before = self._tried
        self._tried = now_s, reached = self._clock(), self._position()
        least = self._patience.least_bytes_per_s * (now_s - before_s)
        return reached - before > max(least, 0)
