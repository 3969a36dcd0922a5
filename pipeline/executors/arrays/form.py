"""An array as a scheduler of containers takes it: files, and the commands that submit them."""

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.executors.arrays.job import ArrayJob
from pipeline.executors.arrays.machines import ArrayMachines
from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import is_reference
from storage.remote.bucket import WRITABLE


@dataclass(frozen=True, kw_only=True)
class ArrayForm:
    """What one scheduler takes."""

    name: str
    """Of the job: the same for the same array, which Kubernetes and Google then refuse twice."""
    files: Mapping[str, str]
    """Texts by file name."""
    commands: Sequence[Sequence[str]]
    """Words of the commands that submit it, one after the other; {folder} is that of the files."""
    afterwards: Sequence[Sequence[str]] = ()
    """Commands that end what costs money without work."""

    def written(self, below: Path) -> list[list[str]]:
        """Write the files to a folder of this job, and return the commands that submit them.

        Raises:
            TrilightError: the folder cannot be written.
        """
        folder = below / self.name
        for name, text in self.files.items():
            write_atomically(folder / name, text.encode())
        return [
            [word.replace("{folder}", str(folder)) for word in command] for command in self.commands
        ]


def array_name(job: ArrayJob, machines: ArrayMachines, on: str) -> str:
    """Return the name of an array: of what is missing, and how it is made."""
    said = repr((on, job.words(on), job.environment, job.at_once, machines))
    return f"trilight-{sha256_hex(said.encode())[:12]}"


def task_environment(job: ArrayJob, machines: ArrayMachines) -> dict[str, str]:
    """Return the variables of each task; containers see all cores of a machine."""
    return {**job.environment, "TRILIGHT_CORES": str(machines.cores), "HOME": "/tmp"}


def image_of(machines: ArrayMachines, on: str) -> str:
    """Return the address of the image; raises TrilightError where none is known."""
    image = machines.image or os.environ.get("TRILIGHT_IMAGE")
    if not image:
        raise TrilightError(
            f"submit {on}: --image is not given; expected the address of Trilight's image as the "
            "machines pull it, such as registry.example/trilight@sha256:... Build and push "
            "infra/images/cpu.Dockerfile, or set TRILIGHT_IMAGE."
        )
    return image


def require_bucket_alone(job: ArrayJob, on: str) -> None:
    """Raise TrilightError where a task would need a file of this machine."""
    order = job.order
    if order.place.partition("://")[0] not in WRITABLE:
        raise TrilightError(
            f"submit {on}: --out is {order.place}; expected a bucket such as s3://bucket/folder: "
            "the machines share nothing else."
        )
    for option, value in (
        ("--objects", order.objects), ("--textures", order.textures), ("--skies", order.skies),
    ):  # fmt: skip
        if value is not None and (":" not in value or value.startswith("file:")):
            raise TrilightError(
                f"submit {on}: {option} is {value}, a folder of this machine; expected a URL or a "
                "named source, which every machine can read. Bring it to a bucket."
            )
    if is_reference(order.build):
        raise TrilightError(
            f"submit {on}: the build is {order.build}, a file of this machine; expected a name. "
            "Put the file into an image of your own, with TRILIGHT_EXTEND, and name its build."
        )


def refuse_unused(machines: ArrayMachines, on: str, fields: Sequence[str], why: str) -> None:
    """Raise TrilightError where something is asked for that a scheduler does not take."""
    for name in fields:
        if getattr(machines, name) != ArrayMachines.__dataclass_fields__[name].default:
            option = f"--{name.replace('_', '-')}"
            raise TrilightError(
                f"submit {on}: {option} is {getattr(machines, name)}; expected it left out: {why}."
            )


def submit_form(commands: Sequence[Sequence[str]], on: str) -> list[str]:
    """Run the commands that submit an array, and return what they said.

    Raises:
        TrilightError: a tool is not installed, or refuses.
    """
    said = []
    for command in commands:
        if shutil.which(command[0]) is None:
            raise TrilightError(
                f"submit {on}: no {command[0]} here; expected it installed and logged in. The "
                "files are written; --dry-run prints the commands that submit them."
            )
        done = subprocess.run(list(command), capture_output=True, text=True, check=False)
        if done.returncode:
            why = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            raise TrilightError(
                f"submit {on}: {command[0]} refused ({why}). Where a job of that name has ended, "
                "delete it, and submit again."
            )
        said.append(done.stdout.strip())
    return said
