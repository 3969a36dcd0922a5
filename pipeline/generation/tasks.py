"""Cuts the missing scenes of a dataset into tasks, in rounds until nothing is missing.

A piece is a range of scenes of one shard; a task is several pieces. Small shards are combined,
large ones are cut. A task takes one to ten minutes, and a run has at most a thousand of them. How
long a scene takes is known only as the run goes, so each task is cut when it is submitted.

Several workers may share a dataset. A round skips the scenes that others have claimed; after it, a
run waits until they are done, and makes the scenes that a killed worker left.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pipeline.generation.generation_run import Run, TaskResult
from pipeline.generation.unfinished_shard import UnfinishedShard
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import scenes_of_shard
from storage.errors import EnvironmentFailure
from storage.file_locks import WaitNotice

MAX_TASKS = 1000
"""Most task runs of one flow run: Prefect's server accepts about 20 a second, of 19 kB each."""
TASK_S = 240.0
"""Target duration of a task, in seconds."""
_FIRST_SCENES = 4
"""Scenes of a task until the duration of one has been measured."""
FIRST_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 60.0
"""Most seconds between two looks at other workers' scenes; the pause doubles while none is free."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A range of scenes of one shard, which a task makes one after another."""

    shard_index: int
    """Number of the shard, from 0."""
    first: int
    """Index of the first scene in the dataset."""
    last: int
    """Index of the last scene plus 1."""


class TaskCutter:
    """Cuts missing scenes into tasks, sized by the durations of finished ones."""

    def __init__(self, at_once: int = 1) -> None:
        """Begin; `at_once` is the number of tasks that run at the same time."""
        self._at_once = at_once
        self._tasks_left = MAX_TASKS
        self._scenes = 0
        self._seconds = 0.0

    def record(self, outcome: TaskResult) -> None:
        """Record the duration of a finished task."""
        if outcome.scenes:
            self._scenes += outcome.scenes
            self._seconds += outcome.seconds

    def cut_round(
        self, shards: Sequence[int], splits: SplitSettings
    ) -> Iterator[tuple[Piece, ...]]:
        """Yield the tasks that make some shards, but save a tenth of the tasks for later rounds.

        Raises:
            EnvironmentFailure: no task is left of the maximum over all rounds.
        """
        if self._tasks_left == 0:
            raise EnvironmentFailure(
                f"this run has handed out all of its {MAX_TASKS} tasks, and other runs hold "
                "claims on the missing scenes. What was finished is safe: run the same command "
                "again."
            )
        for task in self.iter_tasks(shards, splits, most=self._tasks_left - self._tasks_left // 10):
            self._tasks_left -= 1
            yield task

    def iter_tasks(
        self, shards: Sequence[int], splits: SplitSettings, *, most: int = MAX_TASKS
    ) -> Iterator[tuple[Piece, ...]]:
        """Yield at most `most` tasks that make some shards; each is sized when it is requested."""
        scenes_left = sum(len(scenes_of_shard(index, splits)) for index in shards)
        pieces: list[Piece] = []
        room = self._next_size(scenes_left, most)
        for index in shards:
            scenes = scenes_of_shard(index, splits)
            at = scenes.start
            while at < scenes.stop:
                last = min(scenes.stop, at + room)
                pieces.append(Piece(shard_index=index, first=at, last=last))
                room -= last - at
                scenes_left -= last - at
                at = last
                if room == 0:
                    yield tuple(pieces)
                    pieces = []
                    most -= 1
                    room = self._next_size(scenes_left, most)
        if pieces:
            yield tuple(pieces)

    def _next_size(self, scenes_left: int, tasks_left: int) -> int:
        """Return the number of scenes of the next task, at least 1.

        With several tasks at once, none gets more than half of an equal share of the remaining
        scenes, so that all workers have work until the end (guided self-scheduling,
        Polychronopoulos and Kuck 1987).
        """
        size: float = _FIRST_SCENES
        if self._scenes:
            size = TASK_S * self._scenes / max(self._seconds, 1e-3)
        if self._at_once > 1:
            size = min(size, scenes_left / (2 * self._at_once))
        return max(1, int(size), -(-scenes_left // max(1, tasks_left)))


def wait_for_others(run: Run, pause_s: float) -> float:
    """Wait until nothing is missing or a claim is free; return the next pause in seconds.

    No tasks are submitted meanwhile: each would be a row of a scheduler's database.
    """
    writer = run.publication
    notice = WaitNotice()
    while True:
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        missing = run.unfinished_shards()
        splits = run.settings.splits
        shards = [UnfinishedShard(writer.folder, splits, index) for index in missing]
        if not missing or any(shard.is_free() for shard in shards):
            return pause_s
        notice.update(shards[0].missing_claims()[0])


def shard_ranges(num_shards: int, num_ranges: int) -> list[str]:
    """Return `num_ranges` nearly equal ranges A:B of shards; fewer if there are fewer shards."""
    count = min(num_ranges, num_shards)
    bounds = [num_shards * index // count for index in range(count + 1)]
    return [f"{first}:{last}" for first, last in itertools.pairwise(bounds)]
