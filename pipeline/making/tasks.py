"""What is missing of a dataset, cut into tasks, round by round until nothing is.

A piece is a range of scenes of one shard; a task is several pieces. Small shards are put together,
large ones are cut. A task takes one to ten minutes, and a run has at most a thousand of them. How
long a scene takes is known only as the run goes, so tasks are cut one by one, each when it is
handed out.

Several makers may share a dataset. A round leaves out what others are making; after it, a run waits
until they are done, and makes what is left over where one of them died.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pipeline.making.run import Run, TaskOutcome
from pipeline.making.unfinished_shard import UnfinishedShard
from storage.claims import WaitNotice
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import scenes_of_shard
from storage.errors import EnvironmentFailure

MOST_TASKS = 1000
"""Task runs of one flow run: Prefect's server takes in about 20 a second, of 19 kB each."""
TASK_S = 240.0
"""Seconds that a task should take."""
_FIRST_SCENES = 4
"""Scenes of a task before anything is measured."""
_FIRST_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 60.0
"""Between two looks at what others are making; the pause doubles while nothing is left for us."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """Scenes of one shard that a task makes in turn."""

    shard_index: int
    """Which shard."""
    first: int
    """Its first scene, by its index in the dataset."""
    last: int
    """One beyond its last scene."""


class TaskSizes:
    """How many scenes the next task gets, from what the finished ones took."""

    def __init__(self) -> None:
        self._scenes = 0
        self._seconds = 0.0

    def measured(self, scenes: int, seconds: float) -> None:
        """Take the duration of a finished task into account."""
        self._scenes += scenes
        self._seconds += seconds

    def next_size(self, scenes_left: int, tasks_left: int, at_once: int = 1) -> int:
        """Return a number of scenes, at least 1.

        Of several at once nobody gets more than half of an equal share of what is left, so that
        all have work until the end (guided self-scheduling, Polychronopoulos and Kuck 1987).
        """
        wanted: float = _FIRST_SCENES
        if self._scenes:
            wanted = TASK_S * self._scenes / max(self._seconds, 1e-3)
        if at_once > 1:
            wanted = min(wanted, scenes_left / (2 * at_once))
        return max(1, int(wanted), -(-scenes_left // max(1, tasks_left)))


class TasksLeft:
    """How many tasks a run may still hand out: MOST_TASKS, in however many rounds."""

    def __init__(self) -> None:
        self._left = MOST_TASKS

    def cut(
        self, shards: Sequence[int], splits: SplitSettings, sizes: TaskSizes, *, at_once: int
    ) -> Iterator[tuple[Piece, ...]]:
        """Yield as `cut_tasks`, but keep a tenth of what is left for rounds that may follow.

        Raises:
            EnvironmentFailure: none is left.
        """
        if self._left == 0:
            raise EnvironmentFailure(
                f"this run has handed out all of its {MOST_TASKS} tasks, and other runs hold "
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
    most: int = MOST_TASKS,
    at_once: int = 1,
) -> Iterator[tuple[Piece, ...]]:
    """Yield the tasks that make some shards, each of the size that is right when it is asked for.

    Args:
        shards: numbers of the shards.
        splits: how many scenes they have.
        sizes: what is known of the time that scenes take.
        most: tasks to yield at most.
        at_once: tasks that are handed out at the same time.
    """
    scenes_left = sum(len(scenes_of_shard(index, splits)) for index in shards)
    pieces: list[Piece] = []
    room, yielded = sizes.next_size(scenes_left, most, at_once), 0
    for index in shards:
        scenes = scenes_of_shard(index, splits)
        at = scenes.start
        while at < scenes.stop:
            last = min(scenes.stop, at + room)
            pieces.append(Piece(shard_index=index, first=at, last=last))
            room, scenes_left, at = room - (last - at), scenes_left - (last - at), last
            if room == 0:
                yield tuple(pieces)
                pieces, yielded = [], yielded + 1
                room = sizes.next_size(scenes_left, most - yielded, at_once)
    if pieces:
        yield tuple(pieces)


class Round:
    """The tasks of all that is missing now; each is cut when the executor asks for it."""

    def __init__(self, tasks: Iterator[tuple[Piece, ...]], sizes: TaskSizes) -> None:
        self.tasks = tasks
        self.made_anything = False
        self._sizes = sizes

    def record(self, outcome: TaskOutcome) -> None:
        """Take a finished task into account: later tasks get the size that its speed suggests."""
        self.made_anything |= bool(outcome.scenes or outcome.shards)
        if outcome.scenes:
            self._sizes.measured(outcome.scenes, outcome.seconds)


def rounds(run: Run, at_once: int) -> Iterator[Round]:
    """Yield rounds of tasks until no shard that was asked for is missing.

    A run of a range of shards ends earlier: when others are making all that is left of the range.

    Args:
        run: the dataset; its publication must learn of each shard that a task has packed.
        at_once: tasks that are handed out at the same time.

    Raises:
        EnvironmentFailure: the run has handed out as many tasks as it may.
    """
    sizes, tasks, pause_s = TaskSizes(), TasksLeft(), _FIRST_PAUSE_S
    while missing := run.missing_shards():
        this = Round(tasks.cut(missing, run.publication.splits, sizes, at_once=at_once), sizes)
        yield this
        if this.made_anything:
            pause_s = _FIRST_PAUSE_S
        elif run.order.shards is None:
            pause_s = _wait_for_others(run, pause_s)
        else:
            return


def _wait_for_others(run: Run, pause_s: float) -> float:
    """Return the next pause, as soon as nothing is missing or somebody left something undone.

    No tasks are handed out meanwhile: each would be a row of a scheduler's database.
    """
    publication, notice = run.publication, WaitNotice()
    while True:
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        missing = run.missing_shards()
        splits = run.settings.splits
        shards = [UnfinishedShard(publication.folder, splits, index) for index in missing]
        if not missing or any(shard.is_free() for shard in shards):
            return pause_s
        notice.update(shards[0].wanted_claims()[0])


def shard_ranges(num_shards: int, parts: int) -> list[str]:
    """Return nearly equal ranges A:B of shards, as many as there are parts, or shards if fewer."""
    count = min(parts, num_shards)
    bounds = [num_shards * part // count for part in range(count + 1)]
    return [f"{first}:{last}" for first, last in itertools.pairwise(bounds)]
