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

from pipeline.generation.run import Run, TaskResult
from pipeline.generation.unfinished_shard import UnfinishedShard
from storage.claims import WaitNotice
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import scenes_of_shard
from storage.errors import EnvironmentFailure

MAX_TASKS = 1000
"""Most task runs of one flow run: Prefect's server accepts about 20 a second, of 19 kB each."""
TASK_S = 240.0
"""Target duration of a task, in seconds."""
_FIRST_SCENES = 4
"""Scenes of a task until the duration of one has been measured."""
_FIRST_PAUSE_S = 1.0
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


class TaskSizes:
    """Chooses the number of scenes of the next task by the durations of finished tasks."""

    def __init__(self) -> None:
        self._scenes = 0
        self._seconds = 0.0

    def add_measurement(self, scenes: int, seconds: float) -> None:
        """Record the duration of a finished task."""
        self._scenes += scenes
        self._seconds += seconds

    def next_size(self, scenes_left: int, tasks_left: int, at_once: int = 1) -> int:
        """Return the number of scenes of the next task, at least 1.

        With several tasks at once, none gets more than half of an equal share of the remaining
        scenes, so that all workers have work until the end (guided self-scheduling,
        Polychronopoulos and Kuck 1987).
        """
        size: float = _FIRST_SCENES
        if self._scenes:
            size = TASK_S * self._scenes / max(self._seconds, 1e-3)
        if at_once > 1:
            size = min(size, scenes_left / (2 * at_once))
        return max(1, int(size), -(-scenes_left // max(1, tasks_left)))


class TaskBudget:
    """Counts the tasks that a run may still submit: MAX_TASKS over all its rounds."""

    def __init__(self) -> None:
        self._left = MAX_TASKS

    def take_tasks(
        self, shards: Sequence[int], splits: SplitSettings, sizes: TaskSizes, *, at_once: int
    ) -> Iterator[tuple[Piece, ...]]:
        """Yield the tasks of `cut_tasks`, but save a tenth of the remaining ones for later rounds.

        Raises:
            EnvironmentFailure: no task is left.
        """
        if self._left == 0:
            raise EnvironmentFailure(
                f"this run has handed out all of its {MAX_TASKS} tasks, and other runs hold "
                "claims on the missing scenes. What was finished is safe: run the same command "
                "again."
            )
        most = self._left - self._left // 10
        for task in cut_tasks(shards, splits, sizes, most=most, at_once=at_once):
            self._left -= 1
            yield task


def cut_tasks(
    shards: Sequence[int],
    splits: SplitSettings,
    sizes: TaskSizes,
    *,
    most: int = MAX_TASKS,
    at_once: int = 1,
) -> Iterator[tuple[Piece, ...]]:
    """Yield the tasks that make some shards; each is sized when it is requested.

    Args:
        shards: numbers of the shards.
        splits: number of scenes of each shard.
        sizes: durations of the tasks so far.
        most: maximum number of tasks.
        at_once: number of tasks that run at the same time.
    """
    scenes_left = sum(len(scenes_of_shard(index, splits)) for index in shards)
    pieces: list[Piece] = []
    room = sizes.next_size(scenes_left, most, at_once)
    yielded = 0
    for index in shards:
        scenes = scenes_of_shard(index, splits)
        at = scenes.start
        while at < scenes.stop:
            last = min(scenes.stop, at + room)
            pieces.append(Piece(shard_index=index, first=at, last=last))
            room = room - (last - at)
            scenes_left = scenes_left - (last - at)
            at = last
            if room == 0:
                yield tuple(pieces)
                pieces = []
                yielded = yielded + 1
                room = sizes.next_size(scenes_left, most - yielded, at_once)
    if pieces:
        yield tuple(pieces)


class Round:
    """Tasks for all scenes that are missing now; each is cut when the executor requests it."""

    def __init__(self, tasks: Iterator[tuple[Piece, ...]], sizes: TaskSizes) -> None:
        self.tasks = tasks
        self.made_anything = False
        self._sizes = sizes

    def record(self, outcome: TaskResult) -> None:
        """Record a finished task: its speed decides the size of later tasks."""
        self.made_anything |= bool(outcome.scenes or outcome.shards)
        if outcome.scenes:
            self._sizes.add_measurement(outcome.scenes, outcome.seconds)


def iter_rounds_until_done(run: Run, at_once: int) -> Iterator[Round]:
    """Yield rounds of tasks until no requested shard is missing; sleep between two rounds.

    A run of a range of shards ends earlier: when others are making all that is left of the range.

    Args:
        run: the dataset; its writer must record each shard that a task has packed.
        at_once: number of tasks that run at the same time.

    Raises:
        EnvironmentFailure: the run has submitted its maximum number of tasks.
    """
    sizes = TaskSizes()
    tasks = TaskBudget()
    pause_s = _FIRST_PAUSE_S
    while missing := run.unfinished_shards():
        this = Round(
            tasks.take_tasks(missing, run.publication.splits, sizes, at_once=at_once), sizes
        )
        yield this
        if this.made_anything:
            pause_s = _FIRST_PAUSE_S
        elif run.order.shards is None:
            pause_s = _wait_for_others(run, pause_s)
        else:
            return


def _wait_for_others(run: Run, pause_s: float) -> float:
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
