"""An array as an indexed Job of Kubernetes, each of whose pods makes one task.

A pod that its node takes along (a spot machine, a drain, an eviction) does not count; one that
fails is started again so often, each index for itself; one that was asked something wrong (exit
status 2) fails at once. Indices that are made are not run again, whatever becomes of the others.
"""

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

_ON = "kubernetes"
_KEPT_S = 86400
"""How long an ended job stays to be looked at."""


def kubernetes_form(job: ArrayJob, machines: ArrayMachines) -> ArrayForm:
    """Return the manifest of a job, and the command that creates it; raises TrilightError."""
    require_bucket_alone(job, _ON)
    refuse_unused(machines, _ON, ["on_demand"], "the nodes decide, by --machine-type or taints")
    name, namespace = array_name(job, machines, _ON), machines.where or "trilight"
    manifest = {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {
            "name": name, "namespace": namespace, "labels": {"app": "trilight-array"},
        },
        "spec": {
            "completionMode": "Indexed",
            "completions": len(job.tasks),
            "parallelism": min(job.at_once or len(job.tasks), len(job.tasks)),
            "backoffLimitPerIndex": machines.tries - 1,
            "podFailurePolicy": {
                "rules": [
                    {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget"}]},
                    {
                        "action": "FailIndex",
                        "onExitCodes": {"containerName": "task", "operator": "In", "values": [2]},
                    },
                ]
            },
            "ttlSecondsAfterFinished": _KEPT_S,
            "template": {
                "metadata": {"labels": {"app": "trilight-array"}},
                "spec": _pod(job, machines),
            },
        },
    }  # fmt: skip
    return ArrayForm(
        name=name,
        files={"job.yaml": yaml.safe_dump(manifest, sort_keys=False, width=100)},
        commands=[["kubectl", "create", "--filename", "{folder}/job.yaml"]],
    )


def _pod(job: ArrayJob, machines: ArrayMachines) -> dict[str, Any]:
    amounts = {"cpu": str(machines.cores), "memory": f"{machines.memory_gib}Gi"}
    mounts = {"tmp": "/tmp", "cache": "/cache", "data": "/data"}
    pod: dict[str, Any] = {
        "restartPolicy": "Never",
        "activeDeadlineSeconds": round(3600 * machines.task_hours),
        "automountServiceAccountToken": False,
        "securityContext": {
            "runAsNonRoot": True, "runAsUser": 10001, "fsGroup": 10001,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [
            {
                "name": "task",
                "image": image_of(machines, _ON),
                "imagePullPolicy": "IfNotPresent",
                "command": job.words(_ON),
                "env": [
                    {"name": name, "value": value}
                    for name, value in task_environment(job, machines).items()
                ],
                "envFrom": [{"secretRef": {"name": "trilight-bucket", "optional": True}}],
                "resources": {"requests": amounts, "limits": dict(amounts)},
                "securityContext": {
                    "allowPrivilegeEscalation": False,
                    "readOnlyRootFilesystem": True,
                    "capabilities": {"drop": ["ALL"]},
                },
                "volumeMounts": [
                    {"name": name, "mountPath": path} for name, path in mounts.items()
                ],
            }
        ],
        "volumes": [{"name": name, "emptyDir": {}} for name in mounts],
    }  # fmt: skip
    if machines.account:
        pod["serviceAccountName"] = machines.account
    if machines.machine_type:
        pod["nodeSelector"] = {"node.kubernetes.io/instance-type": machines.machine_type}
    return pod
