"""The same epoch read by several processes, each its share: what they would gain over threads."""

import multiprocessing
import time
from collections.abc import Callable, Generator
from contextlib import closing
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from train.data.order import RankShare
    from train.data.scenes import TrainingScene

    Batches = Callable[[str, RankShare], Generator[list[TrainingScene], None, None]]

_PATIENCE_S = 600.0


def seconds_of_processes(batches: "Batches", data: str, num_batches: int, processes: int) -> float:
    """Return from the first one's beginning to the last one's end; imports come before.

    Args:
        batches: returns a rank's share of the global batches of some data; of a module's top level.
        data: as for `--data`.
        num_batches: global batches that are read.
        processes: how many; each is one rank, and hands nothing on.
    """
    context = multiprocessing.get_context("spawn")
    together, times = context.Barrier(processes), context.Queue()
    children = [
        context.Process(
            target=_read, args=(batches, data, num_batches, rank, processes, together, times)
        )
        for rank in range(processes)
    ]
    for child in children:
        child.start()
    spans = [times.get(timeout=_PATIENCE_S) for _ in children]
    for child in children:
        child.join()
    return max(ended for _, ended in spans) - min(began for began, _ in spans)


def _read(
    batches: "Batches",
    data: str,
    num_batches: int,
    rank: int,
    processes: int,
    together: Barrier,
    times: "Queue[tuple[float, float]]",
) -> None:
    from train.data.order import RankShare

    share = RankShare(rank=rank, world_size=processes)
    with closing(batches(data, share)) as found:
        next(found)  # the first one pays for what is imported on the way
    together.wait(_PATIENCE_S)
    began = time.monotonic()  # one clock for all processes of a machine
    with closing(batches(data, share)) as found:
        for _ in range(num_batches):
            next(found)
    times.put((began, time.monotonic()))
