"""Submits the missing shards of a dataset as a Slurm array, by sbatch."""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.executors.array_job import ArrayJob
from pipeline.generation.generate_options import generate_words
from storage.errors import TrilightError
from storage.number_ranges import number_ranges

SCRIPT = Path(__file__).parents[2] / "infra/slurm/generate.sbatch"

_OF_THE_SCRIPT = ("--out", "--scenes", "--objects")
"""Options that the script takes from its environment."""


def sbatch_command(job: ArrayJob, options: Sequence[str] = ()) -> list[str]:
    """Return the command that submits an array, `sbatch` first.

    Args:
        job: the array.
        options: further options of sbatch, such as --partition=cpu.
    """
    limit = f"%{job.at_once}" if job.at_once else ""
    array = f"--array={number_ranges(job.tasks)}{limit}"
    words = _without(generate_words(job.options)[2:], _OF_THE_SCRIPT)
    return ["sbatch", "--parsable", array, *options, str(SCRIPT), *words]


def sbatch_environment(job: ArrayJob) -> Mapping[str, str]:
    """Return the environment variables that the script reads."""
    return {
        "OUT": job.options.place,
        "BUILD": job.options.build,
        "SCENES": str(job.options.scenes),
        "SHARDS_PER_TASK": str(job.per_task),
        "TRILIGHT": str(Path(sys.executable).with_name("trilight")),
        "OBJECTS": job.options.objects or "",  # also overrides a variable of this shell
    }


def submit_slurm_array(job: ArrayJob, options: Sequence[str] = ()) -> str:
    """Submit an array from the folder of this process and return its number.

    Raises:
        TrilightError: there is no sbatch here, or it refuses.
    """
    if shutil.which("sbatch") is None:
        raise TrilightError(
            "submit slurm: no sbatch here; expected a login node of a Slurm cluster. --dry-run "
            "prints the command."
        )
    Path("logs").mkdir(exist_ok=True)  # the script's tasks write their logs here
    done = subprocess.run(
        sbatch_command(job, options),
        env={**os.environ, **sbatch_environment(job)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise TrilightError(f"submit slurm: sbatch refused ({said}).")
    return done.stdout.strip().partition(";")[0]


def _without(words: Sequence[str], options: Sequence[str]) -> list[str]:
    """Return option words without some options and their values."""
    rest: list[str] = []
    skip = False
    for word in words:
        if not skip and word not in options:
            rest.append(word)
        skip = not skip and word in options
    return rest
