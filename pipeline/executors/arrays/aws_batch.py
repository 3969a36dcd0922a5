"""An array as AWS Batch takes it: a job definition, and a job of so many children.

The queue and its compute environment (spot machines, their types, how many at once) are yours; the
role of the job, or of the machines, may write the bucket.
"""

import json
from typing import Any

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

_ON = "aws-batch"


def aws_batch_form(job: ArrayJob, machines: ArrayMachines) -> ArrayForm:
    """Return definition and job, and the commands that register and submit them.

    Raises:
        TrilightError: no queue is named, or something is asked for that the queue decides.
    """
    require_bucket_alone(job, _ON)
    decides = "the compute environment of the queue decides"
    refuse_unused(machines, _ON, ["on_demand", "machine_type"], decides)
    if job.at_once is not None:
        raise TrilightError(
            f"submit {_ON}: --at-once is {job.at_once}; expected it left out: {decides}."
        )
    if not machines.where:
        raise TrilightError(
            f"submit {_ON}: --where is not given; expected the name of a job queue."
        )
    name = array_name(job, machines, _ON)
    submitted: dict[str, Any] = {
        "jobName": name, "jobQueue": machines.where, "jobDefinition": name,
    }  # fmt: skip
    if len(job.tasks) > 1:  # an array of one is refused; a single job has no place
        submitted["arrayProperties"] = {"size": len(job.tasks)}
    return ArrayForm(
        name=name,
        files={
            "definition.json": json.dumps(_definition(name, job, machines), indent=1) + "\n",
            "job.json": json.dumps(submitted, indent=1) + "\n",
        },
        commands=[
            [*("aws", "batch", action, "--cli-input-json"), f"file://{{folder}}/{file}"]
            for action, file in (
                ("register-job-definition", "definition.json"),
                ("submit-job", "job.json"),
            )
        ],
    )


def _definition(name: str, job: ArrayJob, machines: ArrayMachines) -> dict[str, Any]:
    container: dict[str, Any] = {
        "image": image_of(machines, _ON),
        "command": job.words(_ON),
        "environment": [
            {"name": key, "value": value} for key, value in task_environment(job, machines).items()
        ],
        "resourceRequirements": [
            {"type": "VCPU", "value": str(machines.cores)},
            {"type": "MEMORY", "value": str(1024 * machines.memory_gib)},
        ],
        "user": "10001",
        "readonlyRootFilesystem": True,  # /cache and /data are volumes of the image
        "volumes": [{"name": "tmp", "host": {}}],
        "mountPoints": [{"sourceVolume": "tmp", "containerPath": "/tmp", "readOnly": False}],
        "linuxParameters": {"initProcessEnabled": True},
    }
    if machines.account:
        container["jobRoleArn"] = machines.account
    return {
        "jobDefinitionName": name,
        "type": "container",
        "platformCapabilities": ["EC2"],
        "containerProperties": container,
        "retryStrategy": {
            "attempts": machines.tries,
            "evaluateOnExit": [
                {"onExitCode": "2", "action": "EXIT"},  # asked something wrong
                {"onReason": "*", "action": "RETRY"},
            ],
        },
        "timeout": {"attemptDurationSeconds": round(3600 * machines.task_hours)},
    }
