"""An array as Google Batch takes it: one job with so many tasks, each on a machine of its own."""

import json
from typing import Any

from pipeline.executors.arrays.form import (
    ArrayForm,
    array_name,
    image_of,
    require_bucket_alone,
    task_environment,
)
from pipeline.executors.arrays.job import ArrayJob
from pipeline.executors.arrays.machines import ArrayMachines
from storage.errors import TrilightError

_ON = "google-batch"
_DISK_GB = 100
"""Of a machine: the image, and scenes that wait for their shard."""


def google_batch_form(job: ArrayJob, machines: ArrayMachines) -> ArrayForm:
    """Return the job, and the command that submits it.

    Raises:
        TrilightError: it is not said where, or how many machines at once may cost money.
    """
    require_bucket_alone(job, _ON)
    if not machines.where:
        raise TrilightError(
            f"submit {_ON}: --where is not given; expected a location such as us-central1."
        )
    if job.at_once is None:
        raise TrilightError(
            f"submit {_ON}: --at-once is not given; expected the most machines at a time, each of "
            "which costs money."
        )
    name = array_name(job, machines, _ON)
    policy: dict[str, Any] = {
        "provisioningModel": "STANDARD" if machines.on_demand else "SPOT",
        "bootDisk": {"sizeGb": str(_DISK_GB)},
    }
    if machines.machine_type:
        policy["machineType"] = machines.machine_type
    allocation: dict[str, Any] = {"instances": [{"policy": policy}]}
    if machines.account:
        allocation["serviceAccount"] = {"email": machines.account}
    config = {
        "taskGroups": [
            {
                "taskCount": str(len(job.tasks)),
                "parallelism": str(min(job.at_once, len(job.tasks))),
                "taskCountPerNode": "1",
                "taskSpec": _task(job, machines),
            }
        ],
        "allocationPolicy": allocation,
        "labels": {"app": "trilight-array"},
        "logsPolicy": {"destination": "CLOUD_LOGGING"},
    }
    words = ["gcloud", "batch", "jobs", "submit", name, "--location", machines.where]
    return ArrayForm(
        name=name,
        files={"job.json": json.dumps(config, indent=1) + "\n"},
        commands=[[*words, "--config", "{folder}/job.json"]],
    )


def _task(job: ArrayJob, machines: ArrayMachines) -> dict[str, Any]:
    return {
        "runnables": [
            {
                "container": {
                    "imageUri": image_of(machines, _ON),
                    "commands": job.words(_ON),
                    "options": "--init --read-only --tmpfs /tmp",  # /cache and /data are volumes
                }
            }
        ],
        "environment": {"variables": task_environment(job, machines)},
        "computeResource": {
            "cpuMilli": str(1000 * machines.cores),
            "memoryMib": str(1024 * machines.memory_gib),
        },
        "maxRetryCount": machines.tries - 1,
        # asked something wrong; every other failure is tried again
        "lifecyclePolicies": [{"action": "FAIL_TASK", "actionCondition": {"exitCodes": [2]}}],
        "maxRunDuration": f"{round(3600 * machines.task_hours)}s",
    }
