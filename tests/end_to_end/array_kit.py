"""`trilight submit make-by-array`: its flow is killed, the array goes on, another run ends it."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from storage.dataset.verify import verify_dataset
from tests.conftest import ROOT
from tests.end_to_end.conftest import kill_one
from tests.end_to_end.production_kit import call

RUN_S = 900
CLUSTER = f"""#!{sys.executable}
# A cluster of one node: takes an array, says its number, and runs the tasks one after another.
import os, subprocess, sys
words = sys.argv[1:]
array = next(word for word in words if word.startswith("--array=")).removeprefix("--array=")
script, *rest = [word for word in words if not word.startswith("--array=") and word != "--parsable"]
with open(os.environ["FAKE_ASKED"], "a") as asked:
    asked.write(array + "\\n")
loop = 'for task in $TASKS; do SLURM_ARRAY_TASK_ID=$task bash "$@" >> "$FAKE_LOG" 2>&1; done'
spans = [part.split("-") for part in array.partition("%")[0].split(",")]
tasks = [task for span in spans for task in range(int(span[0]), int(span[-1]) + 1)]
subprocess.Popen(["bash", "-c", loop, "loop", script, *rest], start_new_session=True,
                 env={{**os.environ, "TASKS": " ".join(map(str, tasks))}},
                 stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print("4711;fake")
"""
ORDER = (
    "make-by-array smoke --objects builtin:6 --scenes 8 --quiet-hours 0.2 --resolution 16 "
    "--set renders.min_spp=16 --set renders.max_spp=16 --set scenes.num_views=1"
).split()


def with_a_cluster(folder: Path) -> dict[str, str]:
    """Return an environment in which `sbatch` is that of CLUSTER."""
    sbatch = folder / "bin" / "sbatch"
    sbatch.parent.mkdir()
    sbatch.write_text(CLUSTER)
    sbatch.chmod(0o755)
    return {
        **os.environ,
        "PATH": f"{sbatch.parent}:{os.environ['PATH']}",
        "FAKE_ASKED": str(folder / "asked"),
        "FAKE_LOG": str(folder / "tasks.log"),
        "PYTHONUNBUFFERED": "1",
    }


def require_an_array_outlives_its_flow(folder: Path, environment: dict[str, str]) -> None:
    """Kill the flow that asked for an array; its next run ends what the array has made."""
    words = ["submit", *ORDER, "--out", str(folder / "by-array")]
    mark = f"TRILIGHT_SERVED={(Path(environment['TRILIGHT_STATE']) / 'mark').read_text()}"
    with subprocess.Popen(
        [sys.executable, "-m", "trilight", *words], cwd=ROOT, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as watched:  # fmt: skip
        waited_s = 0.0
        while not (folder / "asked").exists() and waited_s < RUN_S and watched.poll() is None:
            time.sleep(0.1)
            waited_s += 0.1
        killed = kill_one("prefect.engine", mark, np.random.default_rng(0))
        told, _ = watched.communicate(timeout=RUN_S)
    assert killed, told
    assert watched.returncode == 1 and "ended as Crashed" in told, told
    ended = json.loads(
        call(["-m", "trilight", *words, "--scheduler", "none", "--json"], environment, RUN_S)
    )
    assert (ended["state"], ended["summary"]["shards"]) == ("Completed", "2 of 2"), (
        folder / "tasks.log"
    ).read_text()
    assert verify_dataset(str(folder / "by-array")).problems == []
    assert (folder / "asked").read_text() == "0-1\n", "the second run asked for nothing"
