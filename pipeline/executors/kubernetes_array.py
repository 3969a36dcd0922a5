"""Submits an array as an indexed Job of Kubernetes, each of whose pods makes one task.

A pod that is lost with its node (a spot machine, a drain, an eviction) does not count as a failure;
a failing pod is started again up to the option `tries`, each index by itself; one with invalid
options (exit status 2) fails at once. Finished indices are not run again.
"""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import yaml

from pipeline.executors.array_job import ArrayJob
from pipeline.generation.generate_options import GenerateOptions, generate_words
from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import is_reference
from storage.number_ranges import number_ranges
from storage.remote.store import WRITABLE
from storage.settings.described import checked, from_record
from storage.settings.ranges import Within

MACHINES = "TRILIGHT_MACHINES"
"""Variable with the path of a JSON file: options of machines, such as {"where": "a-namespace"}."""
_KEPT_S = 86400
"""Seconds that an ended job stays visible in the cluster."""


@checked()
class KubernetesOptions:
    """With kubernetes: options of the machines."""

    REMOVED: ClassVar = ("on_demand",)
    """Options of earlier versions, which are refused with a message."""
    image: str | None = None
    """Address of Trilight's image (infra/images/cpu.Dockerfile) as the machines pull it, best by
    digest; by default TRILIGHT_IMAGE of the environment."""
    where: str | None = None
    """Namespace; by default trilight."""
    account: str | None = None
    """Service account that may write the bucket; by default the secret trilight-bucket says who."""
    machine_type: str | None = None
    """Type of the machines: all must be of one kind of processor. By default the scheduler
    chooses."""
    cores: Annotated[int, Within(1, 1024, unit="cores")] = 8
    """Cores of a task."""
    memory_gib: Annotated[int, Within(1, 24576, unit="GiB")] = 16
    """Memory of a task in GiB."""
    task_hours: Annotated[float, Within(0.1, 336.0, unit="hours")] = 12.0
    """Maximum time of a task before it counts as lost, in hours."""
    tries: Annotated[int, Within(1, 10, unit="tries")] = 5
    """How often a task is started before it is left for the next submission."""
    files: str = "jobs"
    """Folder for the manifest of the array, which gets a folder of its own in it."""


def options_from_environment() -> KubernetesOptions:
    """Return the options of the file that the environment names (MACHINES).

    Raises:
        TrilightError: the file cannot be read, or holds other options.
    """
    name = os.environ.get(MACHINES)
    if not name:
        return KubernetesOptions()
    try:
        record = json.loads(Path(name).read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise TrilightError(
            f"{MACHINES}: {name} cannot be read ({error}); expected a file of JSON with options of "
            'machines, such as {"where": "a-namespace", "cores": 8}.'
        ) from error
    return from_record(KubernetesOptions, record)


def write_job_file(job: ArrayJob, options: KubernetesOptions) -> Path:
    """Write the manifest of a job, in a folder of its name, and return the file.

    Raises:
        TrilightError: a task would need a file of this machine, there is no image, or the folder
            cannot be written.
    """
    manifest = job_manifest(job, options)
    path = Path(options.files) / manifest["metadata"]["name"] / "job.yaml"
    write_atomically(path, yaml.safe_dump(manifest, sort_keys=False, width=100).encode())
    return path


def create_command(manifest: Path) -> list[str]:
    """Return the command that submits a job, `kubectl` first."""
    return ["kubectl", "create", "--filename", str(manifest)]


def submit_job(job: ArrayJob, options: KubernetesOptions) -> Path:
    """Submit a job and return its manifest.

    Raises:
        TrilightError: there is no kubectl here, or it refuses; or as `write_manifest`.
    """
    path = write_job_file(job, options)
    if shutil.which("kubectl") is None:
        raise TrilightError(
            "submit kubernetes: no kubectl here; expected it installed and logged in. The "
            "manifest is written; --dry-run prints the command that submits it."
        )
    done = subprocess.run(create_command(path), capture_output=True, text=True, check=False)
    if done.returncode:
        why = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise TrilightError(
            f"submit kubernetes: kubectl refused ({why}). Where a job of that name has ended, "
            "delete it, and submit again."
        )
    return path


def job_manifest(job: ArrayJob, options: KubernetesOptions) -> dict[str, Any]:
    """Return the manifest of a job; the same array has the same name, which is refused twice.

    Raises:
        TrilightError: a task would need a file of this machine, or there is no image.
    """
    _require_bucket_alone(job.options)
    words = ["trilight", *generate_words(job.options), "--out", job.options.place]
    words += ["--runner", "kubernetes"]
    environment = {
        "SHARDS_PER_TASK": str(job.per_task),
        "TASKS": number_ranges(job.tasks),
        "TRILIGHT_CORES": str(options.cores),  # a container sees all cores of its machine
        "HOME": "/tmp",
    }
    said = repr((words, environment, job.at_once, options))
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {
            "name": f"trilight-{sha256_hex(said.encode())[:12]}",
            "namespace": options.where or "trilight",
            "labels": {"app": "trilight-array"},
        },
        "spec": {
            "completionMode": "Indexed",
            "completions": len(job.tasks),
            "parallelism": min(job.at_once or len(job.tasks), len(job.tasks)),
            "backoffLimitPerIndex": options.tries - 1,
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
                "spec": _pod(words, environment, options),
            },
        },
    }


def _pod(
    words: Sequence[str], environment: dict[str, str], options: KubernetesOptions
) -> dict[str, Any]:
    amounts = {"cpu": str(options.cores), "memory": f"{options.memory_gib}Gi"}
    mounts = {"tmp": "/tmp", "cache": "/cache", "data": "/data"}
    pod: dict[str, Any] = {
        "restartPolicy": "Never",
        "activeDeadlineSeconds": round(3600 * options.task_hours),
        "automountServiceAccountToken": False,
        "securityContext": {
            "runAsNonRoot": True, "runAsUser": 10001, "fsGroup": 10001,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [
            {
                "name": "task",
                "image": _image(options),
                "imagePullPolicy": "IfNotPresent",
                "command": words,
                "env": [{"name": name, "value": value} for name, value in environment.items()],
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
    if options.account:
        pod["serviceAccountName"] = options.account
    if options.machine_type:
        pod["nodeSelector"] = {"node.kubernetes.io/instance-type": options.machine_type}
    return pod


def _image(options: KubernetesOptions) -> str:
    image = options.image or os.environ.get("TRILIGHT_IMAGE")
    if not image:
        raise TrilightError(
            "submit kubernetes: --image is not given; expected the address of Trilight's image as "
            "the machines pull it, such as registry.example/trilight@sha256:... Build and push "
            "infra/images/cpu.Dockerfile, or set TRILIGHT_IMAGE."
        )
    return image


def _require_bucket_alone(options: GenerateOptions) -> None:
    """Raise TrilightError if a task would need a file of this machine."""
    if options.place.partition("://")[0] not in WRITABLE:
        raise TrilightError(
            f"submit kubernetes: --out is {options.place}; expected a bucket such as "
            "s3://bucket/folder: the machines share nothing else."
        )
    for option, value in (
        ("--objects", options.objects),
        ("--textures", options.textures),
        ("--skies", options.skies),
    ):
        if value is not None and (":" not in value or value.startswith("file:")):
            raise TrilightError(
                f"submit kubernetes: {option} is {value}, a folder of this machine; expected a URL "
                "or a named source, which every machine can read. Bring it to a bucket."
            )
    if is_reference(options.build):
        raise TrilightError(
            f"submit kubernetes: the preset is {options.build}, a file of this machine; expected a "
            "name. Put the file into an image of your own, with TRILIGHT_EXTEND, and name its "
            "preset."
        )
