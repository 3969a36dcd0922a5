"""A cluster that is not there: sbatch, srun and scontrol as far as a job file asks for them.

What is imitated, from Slurm's manuals:
    sbatch     reads `#SBATCH` lines; sets SLURM_*; runs the script in the folder of the submission;
               sends what `--signal=B:NAME@S` says to the script alone when the time is nearly up;
               starts it again where it was requeued
    srun       starts a task on each node; passes SIGUSR1 on to the tasks; of SIGTERM it ends the
               step itself, with little time; gives tasks only the cores that its own line asks for
    scontrol   `show hostnames`, and `requeue`, which takes back even a job that was cancelled
Each refuses an option that it does not know.

Time is up when somebody makes the file `time-is-up` in the folder $FAKE_SLURM, and the job is
cancelled when somebody makes `cancel`. What was asked for is in its file `calls`, a line a call.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

PLACE, JOB = Path(os.environ.get("FAKE_SLURM", "")), "4711"
POLL_S, KILL_WAIT_S = 0.02, 0.5
MOST_STARTS = 5
"""A job that is queued again more often than that would never end."""
OPTIONS = {
    "sbatch": {
        "job-name", "nodes", "ntasks-per-node", "gpus-per-node", "cpus-per-task", "time", "signal",
        "requeue", "open-mode", "output",
    },
    "srun": {"cpus-per-task", "kill-on-bad-exit", "wait"},
}  # fmt: skip


def _called(name: str, words: list[str]) -> None:
    with (PLACE / "calls").open("a") as stream:
        stream.write(json.dumps([name, *words]) + "\n")


def _options(name: str, words: list[str]) -> tuple[dict[str, str], list[str]]:
    """Return the options before the first other word, and the rest."""
    found, rest = {}, list(words)
    while rest and rest[0].startswith("--"):
        option, _, value = rest.pop(0).removeprefix("--").partition("=")
        if option not in OPTIONS[name]:
            sys.exit(f"{name}: unrecognized option '--{option}'")
        found[option] = value
    return found, rest


def sbatch(words: list[str]) -> int:
    given, (script, *arguments) = _options("sbatch", words)
    lines = re.findall(r"^#SBATCH (\S+)$", Path(script).read_text(), re.MULTILINE)
    options = _options("sbatch", lines)[0] | given
    to, name, _ = re.fullmatch(r"(B:)?(\w+)@(\d+)", options["signal"]).groups()  # type: ignore[union-attr]
    assert to, "srun's own way with signals is not imitated"
    starts = 0
    while starts < MOST_STARTS:
        environment = os.environ | _variables(options, starts)
        with subprocess.Popen(["bash", script, *arguments], env=environment) as shell:
            while shell.poll() is None:
                time.sleep(POLL_S)
                if _taken("time-is-up"):
                    shell.send_signal(signal.Signals[f"SIG{name}"])
                if (PLACE / "steps").exists() and _taken("cancel"):
                    _cancel([int(pid) for pid in (PLACE / "steps").read_text().split()])
        starts += 1
        if not ("requeue" in options and _taken("requeue")):
            return shell.returncode
    sys.exit(f"sbatch: job {JOB} was queued again {MOST_STARTS} times")


def _cancel(tasks: list[int]) -> None:
    """End tasks as Slurm does; a shell that becomes another program may miss the first signal."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        for pid in tasks:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        time.sleep(KILL_WAIT_S)


def _variables(options: Mapping[str, str], starts: int) -> dict[str, str]:
    nodes = int(options["nodes"])
    return {
        "SLURM_JOB_ID": JOB,
        "SLURM_NNODES": str(nodes),
        "SLURM_JOB_NODELIST": ",".join(["localhost"] * nodes),
        "SLURM_NTASKS_PER_NODE": options["ntasks-per-node"],
        "SLURM_GPUS_ON_NODE": options["gpus-per-node"],
        "SLURM_CPUS_PER_TASK": options["cpus-per-task"],
        **({"SLURM_RESTART_COUNT": str(starts)} if starts else {}),
    }


def _taken(name: str) -> bool:
    """Return whether a file is there, and take it away."""
    found = (PLACE / name).exists()
    (PLACE / name).unlink(missing_ok=True)
    return found


def srun(words: list[str]) -> int:
    options, command = _options("srun", words)
    own = {name: value for name, value in os.environ.items() if name != "SLURM_CPUS_PER_TASK"}
    if "cpus-per-task" in options:
        own["SLURM_CPUS_PER_TASK"] = options["cpus-per-task"]
    nodes, each = int(own["SLURM_NNODES"]), int(own["SLURM_NTASKS_PER_NODE"])
    tasks: list[subprocess.Popen[bytes]] = []
    early: list[int] = []

    def pass_on(number: int, _: object = None) -> None:
        if len(tasks) < nodes * each:  # a task that is not there yet gets it as well
            early.append(number)
            return
        for task in tasks:
            task.send_signal(number)
        if number == signal.SIGTERM:
            time.sleep(KILL_WAIT_S)
            for task in tasks:
                task.kill()

    for number in (signal.SIGUSR1, signal.SIGTERM):  # before the first task, whom srun must outlive
        signal.signal(number, pass_on)
    for rank in range(nodes * each):
        ranks = {"SLURM_PROCID": rank, "SLURM_NODEID": rank // each, "SLURM_LOCALID": rank % each}
        named = {name: str(number) for name, number in ranks.items()}
        environment = own | named | {"SLURMD_NODENAME": "localhost"}
        tasks.append(subprocess.Popen(command, env=environment, start_new_session=True))
    begun = PLACE / "steps.part"
    begun.write_text(" ".join(str(task.pid) for task in tasks))
    begun.rename(PLACE / "steps")  # whole, since who cancels may look at any time
    for late in early:
        pass_on(late)
    return max(task.wait() % 256 for task in tasks)


def scontrol(words: list[str]) -> int:
    if words[:2] == ["show", "hostnames"]:
        sys.stdout.write(words[2].replace(",", "\n") + "\n")
    elif words == ["requeue", JOB]:
        (PLACE / "requeue").touch()
    else:
        sys.exit(f"scontrol: {words} is not imitated")
    return 0


def commands_in(folder: Path) -> Path:
    """Write the three commands into a folder for PATH, and return it."""
    for name in ("sbatch", "srun", "scontrol"):
        path = folder / name
        path.write_text(f'#!/bin/sh\nexec {sys.executable} -S {__file__} {name} "$@"\n')
        path.chmod(0o755)
    return folder


if __name__ == "__main__":
    _called(sys.argv[1], sys.argv[2:])
    sys.exit({"sbatch": sbatch, "srun": srun, "scontrol": scontrol}[sys.argv[1]](sys.argv[2:]))
