"""An executor of your own: a process for each shard, started by a command.

    trilight generate tiny --extend executor.py --runner commands --workers 4 --out data/smoke

Put `srun`, `ssh` or `docker run` in front of the command, and the same lines use other machines:
all that they must share is the folder, or the bucket, that `--out` names. Who makes which shard
changes no byte, so that an executor is not recorded, and any other may go on where this one ended.
"""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

from trilight.extend import (
    EXECUTORS,
    Executor,
    GenerateOptions,
    Outcome,
    ThreadRunner,
    TrilightError,
    generate_words,
    make_dataset,
    prepare_dataset,
)

TRILIGHT = (sys.executable, "-m", "trilight")


def by_commands(options: GenerateOptions, address: str | None) -> Outcome:
    """Make every missing shard in a process of its own, then finish what is left here."""
    missing = prepare_dataset(options).publication.unfinished_shards()
    words = (*TRILIGHT, *generate_words(options), "--out", options.place)

    def make(shard: int) -> None:
        command = [*words, "--range", f"{shard}:{shard + 1}"]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        if ran.returncode:
            said = ran.stderr.strip().splitlines() or ["it said nothing"]
            raise TrilightError(f"shard {shard} could not be made: {said[-1]}")

    with ThreadPoolExecutor(options.workers or 2) as starters:
        list(starters.map(make, missing))
    return make_dataset(options, ThreadRunner())


EXECUTORS.register("commands", Executor(make=by_commands))
