"""Submits the missing shards of a dataset as an array of tasks, to Slurm or to Kubernetes.

Task K makes `per_task` shards from shard K * `per_task` on, so that a task means the same whenever
it is submitted, and missing tasks can be submitted alone. Slurm numbers tasks so; Kubernetes counts
from 0, and gets these numbers as TASKS (pipeline.executors.threads).

A pod of Kubernetes that is lost with its node (a spot machine, a drain, an eviction) does not count
as a failure; a failing pod is started again up to the option `tries`, each index by itself; one
with invalid options (exit status 2) fails at once. Finished indices are not run again.
"""

import dataclasses
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import yaml

from pipeline.generation.generate_options import GenerateOptions, generate_words
from storage.atomic import write_atomically
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import missing_shards
from storage.dataset.splits import shards_for
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import is_reference
from storage.number_ranges import number_ranges
from storage.remote.store import WRITABLE
from storage.remote.url import safe_url
from storage.settings.described import checked, from_record
from storage.settings.ranges import Within

MAX_TASKS = 1000
"""Most tasks of one array: a Slurm cluster with the default MaxArraySize refuses task 1001."""


@checked()
class DatasetByArray(GenerateOptions):
    """A dataset made by the tasks of a scheduler's array."""

    scheduler: Literal["slurm", "kubernetes", "none"] = "slurm"
    """Scheduler that gets the missing tasks; none only shows the progress of submitted ones."""
    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """Number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """Maximum number of tasks that run at the same time; by default the scheduler decides."""
    quiet_hours: Annotated[float, Within(0.0001, 1000.0, unit="hours")] = 6.0
    """Longest time without a new scene in hours, waiting in the queue included, after which the run
    fails; the array is left as it is."""


@dataclass(frozen=True, kw_only=True)
class ArrayJob:
    """One submission of an array."""

    options: GenerateOptions
    """Options of the dataset, with its number of scenes."""
    tasks: Sequence[int]
    """Numbers of the tasks with missing shards; empty if nothing is missing."""
    per_task: int
    at_once: int | None
    """Most tasks that run at the same time; None leaves it to the scheduler."""


def array_job(
    options: GenerateOptions, *, per_task: int | None, at_once: int | None, on: str = "slurm"
) -> ArrayJob:
    """Return the array that makes the missing shards of a dataset, which need not exist yet.

    Args:
        per_task: shards of a task; by default as few as MAX_TASKS tasks allow.
        at_once: most tasks that run at the same time.
        on: name of the scheduler, for messages.

    Raises:
        TrilightError: the options name scene files, a range of shards or a password, the dataset
            cannot be read, or the array would have too many tasks.
    """
    if options.scenes_from or options.revisits or options.shards:
        raise TrilightError(
            f"submit {on}: expected no --scenes-from, --revisits or --range: the array divides "
            "scenes that are composed. Start such a dataset by trilight generate on each machine."
        )
    source = options.objects or ""
    if safe_url(source) != source and "://" in source:
        raise TrilightError(
            f"submit {on}: --objects {safe_url(source)} holds a password, which every "
            "user of the cluster could read in the queue; expected env:TRILIGHT_SOURCE_NAME, with "
            "the address in that variable of the tasks."
        )
    scenes = options.num_scenes
    planned = shards_for(scenes, options.settings.splits)
    is_begun = _is_begun(options.folder)
    missing = missing_shards(options.place, scenes) if is_begun else list(range(planned))
    each = per_task or -(-planned // MAX_TASKS)
    tasks = sorted({shard // each for shard in missing})
    if tasks and tasks[-1] >= MAX_TASKS:
        raise TrilightError(
            f"--shards-per-task is {each}: the array would end with task {tasks[-1]}; expected at "
            f"most {MAX_TASKS - 1}, which schedulers allow by default. {-(-planned // MAX_TASKS)}"
            " shards a task fit."
        )
    fields = {name: getattr(options, name) for name in GenerateOptions.__dataclass_fields__}
    dataset = GenerateOptions(**{**fields, "scenes": scenes, "out": options.place, "workers": None})
    return ArrayJob(options=dataset, tasks=tasks, per_task=each, at_once=at_once)


def _is_begun(folder: DatasetFolder) -> bool:
    return folder.store().get(folder.manifest.name, 1) is not None


SCRIPT = Path(__file__).parents[2] / "infra/slurm/generate.sbatch"
_JOB = Path(__file__).parents[2] / "infra/kubernetes/array/job.yaml"


def submit_slurm_array(
    job: ArrayJob, options: Sequence[str] = (), *, dry_run: bool = False
) -> tuple[str | None, str]:
    """Submit an array from the folder of this process, with further options of sbatch.

    Returns:
        The number of the array, None for a dry run; and a line of a shell that does the same.

    Raises:
        TrilightError: there is no sbatch here, or it refuses.
    """
    limit = f"%{job.at_once}" if job.at_once else ""
    array = f"--array={number_ranges(job.tasks)}{limit}"
    rest = dataclasses.replace(job.options, scenes=None, objects=None)  # the script has these
    words = generate_words(rest)[2:]
    command = ["sbatch", "--parsable", array, *options, str(SCRIPT), *words]
    variables = {
        "OUT": job.options.place,
        "BUILD": job.options.build,
        "SCENES": str(job.options.scenes),
        "SHARDS_PER_TASK": str(job.per_task),
        "TRILIGHT": str(Path(sys.executable).with_name("trilight")),
        "OBJECTS": job.options.objects or "",  # also overrides a variable of this shell
    }
    # without the folder of the logs all tasks fail
    set_all = [f"{name}={shlex.quote(value)}" for name, value in variables.items()]
    line = " ".join(["mkdir -p logs &&", *set_all, shlex.join(command)])
    if dry_run:
        return None, line
    _require_command("slurm", "sbatch", "a login node of a Slurm cluster")
    Path("logs").mkdir(exist_ok=True)
    return _submit("slurm", command, variables).strip().partition(";")[0], line


def _require_command(on: str, command: str, expected: str) -> None:
    if shutil.which(command) is None:
        raise TrilightError(
            f"submit {on}: no {command} here; expected {expected}. --dry-run prints the command."
        )


def _submit(
    on: str, command: Sequence[str], variables: Mapping[str, str] | None = None, hint: str = ""
) -> str:
    """Run a scheduler's command and return what it prints; raises TrilightError if it refuses."""
    environment = {**os.environ, **(variables or {})}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise TrilightError(f"submit {on}: {command[0]} refused ({said}).{hint}")
    return done.stdout


MACHINES = "TRILIGHT_MACHINES"
"""Variable with the path of a JSON file: options of machines, such as {"where": "a-namespace"}."""


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


def submit_job(
    job: ArrayJob, options: KubernetesOptions, *, dry_run: bool = False
) -> tuple[Path, list[str]]:
    """Write the manifest of a job, in a folder of its name, and submit it unless `dry_run`.

    Returns:
        The file of the manifest, and the command that submits it.

    Raises:
        TrilightError: as `job_manifest`; the folder cannot be written; there is no kubectl here, or
            it refuses.
    """
    manifest = job_manifest(job, options)
    path = Path(options.files) / manifest["metadata"]["name"] / "job.yaml"
    write_atomically(path, yaml.safe_dump(manifest, sort_keys=False, width=100).encode())
    command = ["kubectl", "create", "--filename", str(path)]
    if not dry_run:
        expected = f"it installed and logged in. The manifest is written ({path})"
        _require_command("kubernetes", command[0], expected)
        hint = " Where a job of that name has ended, delete it, and submit again."
        _submit("kubernetes", command, hint=hint)
    return path, command


def job_manifest(job: ArrayJob, options: KubernetesOptions) -> dict[str, Any]:
    """Return the manifest of a job; the same array has the same name, which is refused twice.

    Raises:
        TrilightError: a task would need a file of this machine, or there is no image.
    """
    _require_bucket_alone(job.options)
    image = options.image or os.environ.get("TRILIGHT_IMAGE")
    if not image:
        raise TrilightError(
            "submit kubernetes: --image is not given; expected the address of Trilight's image as "
            "the machines pull it, such as registry.example/trilight@sha256:... Build and push "
            "infra/images/cpu.Dockerfile, or set TRILIGHT_IMAGE."
        )
    words = ["trilight", *generate_words(job.options), "--out", job.options.place]
    words += ["--runner", "kubernetes"]
    environment = {
        "SHARDS_PER_TASK": str(job.per_task),
        "TASKS": number_ranges(job.tasks),
        "TRILIGHT_CORES": str(options.cores),  # a container sees all cores of its machine
        "HOME": "/tmp",
    }
    said = repr((words, environment, job.at_once, options))
    amounts = {"cpu": str(options.cores), "memory": f"{options.memory_gib}Gi"}
    manifest: dict[str, Any] = yaml.safe_load(_JOB.read_bytes())
    manifest["metadata"]["name"] = f"trilight-{sha256_hex(said.encode())[:12]}"
    manifest["metadata"]["namespace"] = options.where or "trilight"
    spec = manifest["spec"]
    spec["completions"] = len(job.tasks)
    spec["parallelism"] = min(job.at_once or len(job.tasks), len(job.tasks))
    spec["backoffLimitPerIndex"] = options.tries - 1
    pod = spec["template"]["spec"]
    pod["activeDeadlineSeconds"] = round(3600 * options.task_hours)
    if options.account:
        pod["serviceAccountName"] = options.account
    if options.machine_type:
        pod["nodeSelector"] = {"node.kubernetes.io/instance-type": options.machine_type}
    pod["containers"][0] |= {
        "image": image,
        "command": words,
        "env": [{"name": name, "value": value} for name, value in environment.items()],
        "resources": {"requests": amounts, "limits": dict(amounts)},
    }
    return manifest


def _require_bucket_alone(options: GenerateOptions) -> None:
    """Raise TrilightError if a task would need a file of this machine."""
    if options.place.partition("://")[0] not in WRITABLE:
        raise TrilightError(
            f"submit kubernetes: --out is {options.place}; expected a bucket such as "
            "s3://bucket/folder: the machines share nothing else."
        )
    for option in ("objects", "textures", "skies"):
        value = getattr(options, option)
        if value is not None and (":" not in value or value.startswith("file:")):
            raise TrilightError(
                f"submit kubernetes: --{option} is {value}, a folder of this machine; expected a "
                "URL or a named source, which every machine can read. Bring it to a bucket."
            )
    if is_reference(options.build):
        raise TrilightError(
            f"submit kubernetes: the preset is {options.build}, a file of this machine; expected a "
            "name. Put the file into an image of your own, with TRILIGHT_EXTEND, and name its "
            "preset."
        )
