"""What threads that share one lock bring, simulated: no machine with enough cores is needed."""

import heapq
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Part:
    """Work that a thread does for each sample, in equal pieces without the lock and under it."""

    free_s: float
    """Seconds without the lock."""
    locked_s: float
    """Seconds under it."""
    pieces: int
    """How often it takes the lock."""


def samples_a_second(
    decoding: Part, consuming: Part, threads: int, *, ahead: int, seconds: float = 20.0
) -> float:
    """Return how many samples one thread consumes that others decode, each on its own core.

    The lock goes to whoever asked first, and changing hands takes no time.

    Args:
        decoding: work of one of the threads for a sample.
        consuming: work of the main thread for a sample.
        threads: how many decode.
        ahead: samples that may wait; threads rest while so many do.
        seconds: that are simulated.
    """
    parts = [consuming] + threads * [decoding]
    left = [part.pieces for part in parts]
    asking = [(part.free_s / part.pieces, row) for row, part in enumerate(parts) if row]
    resting: list[int] = [0]  # whoever waits for a sample, or for room
    ready = used = 0
    time = lock_free_at = 0.0
    while time < seconds:
        time, row = heapq.heappop(asking)
        part = parts[row]
        lock_free_at = max(time, lock_free_at) + part.locked_s / part.pieces
        left[row] -= 1
        going = [row]
        if not left[row]:
            left[row] = part.pieces
            ready, used = (ready + 1, used) if row else (ready, used + 1)
            resting.append(row)
            going = []
        for other in list(resting):
            if (ready > 0) if other == 0 else (ready < ahead):
                ready -= other == 0
                resting.remove(other)
                going.append(other)
        for other in going:
            free_s = parts[other].free_s / parts[other].pieces
            heapq.heappush(asking, (lock_free_at + free_s, other))
    return used / seconds
