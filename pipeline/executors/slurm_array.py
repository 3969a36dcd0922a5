"""A Slurm array of what is missing of a dataset: its specification, and its submission.

Task K makes `per_task` shards from K times that number on (pipeline.executors.slurm), so that a
task means the same whenever it is submitted, and what is missing can be submitted alone.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.builds.named import BUILDS, named_build
from pipeline.making.dataset_order import DatasetOrder, generate_words
from storage.dataset.dataset import dataset_files
from storage.dataset.layout import dataset_folder
from storage.dataset.progress import missing_shards, number_ranges
from storage.dataset.splits import shards_for
from storage.errors import TrilightError
from storage.remote.safe_url import safe_url
from storage.settings.changes import changed

MOST_TASKS = 1000
"""Of one array: a cluster whose MaxArraySize is not changed refuses task 1001."""

SCRIPT = Path(__file__).parents[2] / "infra/slurm/generate.sbatch"

_OF_THE_SCRIPT = ("--out", "--scenes", "--objects")
"""Options that the script takes from its environment."""


@dataclass(frozen=True, kw_only=True)
class ArrayJob:
    """One submission."""

    tasks: Sequence[int]
    """Numbers of the tasks that have something to make; none where nothing is missing."""
    per_task: int
    """Shards of a task."""
    at_once: int | None
    """Most tasks that run at the same time; None for as many as the cluster lets."""
    environment: Mapping[str, str]
    """What the script reads."""
    words: Sequence[str]
    """Options of `trilight generate` besides."""
    options: Sequence[str]
    """Options of sbatch besides, such as --partition=cpu."""

    def command(self) -> list[str]:
        """Return the words of the submission, `sbatch` first."""
        limit = f"%{self.at_once}" if self.at_once else ""
        array = f"--array={number_ranges(self.tasks)}{limit}"
        return ["sbatch", "--parsable", array, *self.options, str(SCRIPT), *self.words]


def array_job(
    order: DatasetOrder, *, per_task: int | None, at_once: int | None, options: Sequence[str] = ()
) -> ArrayJob:
    """Return the array that makes what is missing of a dataset, which need not be begun.

    Args:
        order: the dataset.
        per_task: shards of a task; by default as few as an array has tasks for.
        at_once: most tasks at the same time.
        options: of sbatch, besides.

    Raises:
        TrilightError: the order is of scene files or of a part, names a password, its dataset
            cannot be read, or the array would have too many tasks.
    """
    if order.scenes_from or order.revisits or order.shards:
        raise TrilightError(
            "submit slurm: expected no --scenes-from, --revisits or --shards: the array divides "
            "scenes that are composed. Start such a dataset by trilight generate on each machine."
        )
    if order.objects and safe_url(order.objects) != order.objects and "://" in order.objects:
        raise TrilightError(
            f"submit slurm: --objects {safe_url(order.objects)} holds a password, which every user "
            "of the cluster could read in the queue; expected env:TRILIGHT_SOURCE_NAME, with the "
            "address in that variable of the tasks."
        )
    scenes = order.scenes or BUILDS.find(order.build).num_scenes
    splits = changed(named_build(order.build), order.changes).splits
    planned = shards_for(scenes, splits)
    missing = missing_shards(order.place) if _is_begun(order.place) else list(range(planned))
    each = per_task or -(-planned // MOST_TASKS)
    tasks = sorted({shard // each for shard in missing})
    if tasks and tasks[-1] >= MOST_TASKS:
        raise TrilightError(
            f"--shards-per-task is {each}: the array would end with task {tasks[-1]}; expected at "
            f"most {MOST_TASKS - 1}, which Slurm allows by default. {-(-planned // MOST_TASKS)} "
            "shards a task fit."
        )
    words = generate_words(order)[2:]
    environment = {
        "OUT": order.place,
        "BUILD": order.build,
        "SCENES": str(scenes),
        "SHARDS_PER_TASK": str(each),
        "TRILIGHT": str(Path(sys.executable).with_name("trilight")),
        "OBJECTS": order.objects or "",  # also where this shell has one of its own
    }
    return ArrayJob(
        tasks=tasks,
        per_task=each,
        at_once=at_once,
        environment=environment,
        words=_without(words, _OF_THE_SCRIPT),
        options=options,
    )


def submit_array(job: ArrayJob) -> str:
    """Submit an array from the folder of this process and return its number.

    Raises:
        TrilightError: there is no sbatch here, or it refuses.
    """
    if shutil.which("sbatch") is None:
        raise TrilightError(
            "submit slurm: no sbatch here; expected a login node of a Slurm cluster. --dry-run "
            "prints the command."
        )
    Path("logs").mkdir(exist_ok=True)  # where the script's tasks write
    done = subprocess.run(
        job.command(),
        env={**os.environ, **job.environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise TrilightError(f"submit slurm: sbatch refused ({said}).")
    return done.stdout.strip().partition(";")[0]


def _is_begun(place: str) -> bool:
    """Return whether a folder or bucket holds a dataset's manifest."""
    folder = dataset_folder(place)
    if not folder.bucket:
        return folder.manifest.exists()
    found = dataset_files(place).open_beside(folder.manifest.name)
    if found is None:
        return False
    found.close()
    return True


def _without(words: Sequence[str], options: Sequence[str]) -> list[str]:
    """Return option words without some options and their values."""
    kept: list[str] = []
    skip = False
    for word in words:
        if not skip and word not in options:
            kept.append(word)
        skip = not skip and word in options
    return kept
