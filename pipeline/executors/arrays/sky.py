"""An array as SkyPilot takes it: a pool of (spot) machines, and so many managed jobs on them.

Each job runs the image with Docker, which SkyPilot's machines have: SkyPilot would install itself
into a container that is its runtime, and ours lets nobody be root. A job whose machine is taken
away runs again on another one.
"""

import shlex
from typing import Any

import yaml

from pipeline.executors.arrays.form import (
    ArrayForm,
    array_name,
    image_of,
    refuse_unused,
    require_bucket_alone,
    task_environment,
)
from pipeline.executors.arrays.job import ArrayJob
from pipeline.executors.arrays.machines import ArrayMachines
from storage.errors import TrilightError

_ON = "sky"
_DISK_GB = 100
"""Of a machine: the image, and scenes that wait for their shard."""
_PASSED_ON = (
    "SKYPILOT_JOB_RANK", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_ENDPOINT_URL",
)  # fmt: skip
"""Variables of a machine that the container gets, where they are set."""


def sky_form(job: ArrayJob, machines: ArrayMachines) -> ArrayForm:
    """Return pool and job, and the commands that begin them.

    Raises:
        TrilightError: it is not said how many machines at once may cost money, or something is
            asked for that SkyPilot does not take.
    """
    require_bucket_alone(job, _ON)
    refuse_unused(machines, _ON, ["account", "task_hours"], "SkyPilot has no such thing")
    if job.at_once is None:
        raise TrilightError(
            f"submit {_ON}: --at-once is not given; expected the number of machines of the pool, "
            "each of which costs money."
        )
    name = array_name(job, machines, _ON)
    resources = _resources(machines)
    pool = {
        "pool": {"workers": min(job.at_once, len(job.tasks))},
        "resources": resources,
        "setup": f"docker pull --quiet {shlex.quote(image_of(machines, _ON))}\n",
    }
    recovery = {"job_recovery": {"max_restarts_on_errors": machines.tries - 1}}
    begun = {"name": name, "resources": resources | recovery, "run": _run(job, machines)}
    many = ["--pool", name, "--num-jobs", str(len(job.tasks))]
    return ArrayForm(
        name=name,
        files={
            file: yaml.safe_dump(text, sort_keys=False, width=4096)
            for file, text in (("pool.yaml", pool), ("job.yaml", begun))
        },
        commands=[
            ["sky", "jobs", "pool", "apply", "--yes", "--pool", name, "{folder}/pool.yaml"],
            ["sky", "jobs", "launch", "--yes", "--async", *many, "{folder}/job.yaml"],
        ],
        afterwards=[["sky", "jobs", "pool", "down", "--yes", name]],
    )


def _resources(machines: ArrayMachines) -> dict[str, Any]:
    chosen: dict[str, Any] = {"infra": machines.where} if machines.where else {}
    if machines.machine_type:
        chosen["instance_type"] = machines.machine_type
    return {
        **chosen,
        "cpus": f"{machines.cores}+",
        "memory": f"{machines.memory_gib}+",
        "use_spot": not machines.on_demand,
        "disk_size": _DISK_GB,
    }


def _run(job: ArrayJob, machines: ArrayMachines) -> str:
    variables = [f"{key}={value}" for key, value in task_environment(job, machines).items()]
    options = [
        # the address that gives a machine's role its key is not reached from a network of Docker
        *("--rm", "--init", "--network", "host", "--read-only", "--tmpfs", "/tmp"),
        *(word for given in (*variables, *_PASSED_ON) for word in ("--env", given)),
    ]
    words = ["docker", "run", *options, image_of(machines, _ON), *job.words(_ON)]
    return f"exec {shlex.join(words)}\n"
