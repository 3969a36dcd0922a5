"""`--runner slurm`: makes the shards of one task of a Slurm array, on threads.

infra/slurm/generate.sbatch submits such an array. No task submits another, and none waits for
another: they share the folder or bucket that `--out` names, and the task that makes the last shard
finishes the dataset. It has not run on a real Slurm cluster yet; tests give it the variables that
Slurm's manual documents.
"""

import os
from collections.abc import Callable, Mapping

from pipeline.executors.threads import make_part, number
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome
from pipeline.generation.pipeline import prepare_dataset
from pipeline.generation.tasks import shard_ranges
from storage.errors import TrilightError


def make(options: GenerateOptions, address: str | None) -> Outcome:
    """Make the shards of this array task.

    Raises:
        TrilightError: this is no task of an array, or as `make_part`.
    """

    def shards() -> str:
        return shards_of_task(os.environ, lambda: prepare_dataset(options).publication.num_shards)

    return make_part(options, "slurm", shards)


def shards_of_task(environment: Mapping[str, str], num_shards: Callable[[], int]) -> str:
    """Return the range A:B of shards of this task.

    With SHARDS_PER_TASK it depends on SLURM_ARRAY_TASK_ID alone, so that single tasks can be
    submitted again. Without it, all tasks get equal ranges; if there are more tasks than shards,
    several tasks get the same range.

    Args:
        environment: variables that Slurm and the user set.
        num_shards: returns the number of shards of the dataset; called only if it is needed.

    Raises:
        TrilightError: a variable is missing or not a number, or the array has gaps.
    """
    task = number(environment, "SLURM_ARRAY_TASK_ID", "slurm", least=0)
    if environment.get("SHARDS_PER_TASK"):
        each = number(environment, "SHARDS_PER_TASK", "slurm", least=1)
        return f"{task * each}:{(task + 1) * each}"
    first, last = (
        number(environment, f"SLURM_ARRAY_TASK_{end}", "slurm", least=0) for end in ("MIN", "MAX")
    )
    count = number(environment, "SLURM_ARRAY_TASK_COUNT", "slurm", least=1)
    step = (last - first) // (count - 1) if count > 1 else 1
    if first + step * (count - 1) != last or (task - first) % max(1, step):
        raise TrilightError(
            f"--runner slurm: the array has {count} tasks between {first} and {last}, with gaps; "
            "expected one without, such as --array=0-63. Or set SHARDS_PER_TASK: task K then makes "
            "that many shards from K times that number."
        )
    ranges = shard_ranges(num_shards(), count)
    return ranges[(task - first) // step % len(ranges)]
