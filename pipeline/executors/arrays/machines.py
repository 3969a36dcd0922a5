"""What an array runs on where its tasks are containers: image, machines, accounts."""

from typing import Annotated

from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class ArrayMachines:
    """With kubernetes, sky, aws-batch or google-batch: the machines."""

    image: str | None = None
    """Address of Trilight's image (infra/images/cpu.Dockerfile) as the machines pull it, best by
    digest; by default TRILIGHT_IMAGE of the environment."""
    where: str | None = None
    """Kubernetes: the namespace, by default trilight. AWS Batch: the job queue. Google Batch: the
    location, such as us-central1. SkyPilot: the infrastructure, such as aws or gcp/us-central1, by
    default the cheapest."""
    account: str | None = None
    """Who may write the bucket: on Kubernetes a service account, on AWS Batch the ARN of a role, on
    Google Batch the address of a service account. By default that of the machines, and on
    Kubernetes the secret trilight-bucket."""
    machine_type: str | None = None
    """Type of the machines: all must be of one kind of processor. By default the scheduler
    chooses; on AWS Batch the queue decides."""
    cores: Annotated[int, Within(1, 1024, unit="cores")] = 8
    """Cores of a task."""
    memory_gib: Annotated[int, Within(1, 24576, unit="GiB")] = 16
    """Memory of a task in GiB."""
    task_hours: Annotated[float, Within(0.1, 336.0, unit="hours")] = 12.0
    """Maximum time of a task before it counts as lost, in hours; with SkyPilot there is none."""
    tries: Annotated[int, Within(1, 10, unit="tries")] = 5
    """How often the scheduler starts a task before it is left for the next submission. On AWS and
    Google a machine that is taken away counts too."""
    on_demand: bool = False
    """On Google Batch and SkyPilot: machines that are never taken away, instead of spot machines.
    On Kubernetes and AWS Batch nodes and queue decide."""
    files: str = "jobs"
    """Folder for the files of the array, which get one of their own in it."""
