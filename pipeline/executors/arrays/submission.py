"""What is missing of a dataset, submitted to a scheduler, whichever it is."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

from pipeline.executors.arrays.form import submit_form
from pipeline.executors.arrays.forms import FORMS
from pipeline.executors.arrays.job import ArrayJob
from pipeline.executors.arrays.machines import ArrayMachines
from pipeline.executors.slurm_array import submit_array
from storage.errors import TrilightError
from storage.settings.described import from_record

SLURM = "slurm"
ARRAYS = (SLURM, *FORMS)
"""The schedulers."""
MACHINES = "TRILIGHT_MACHINES"
"""Variable that names a file of JSON: options of machines, such as {"where": "a-job-queue"}."""


def submitted(job: ArrayJob, on: str, machines: ArrayMachines, sbatch: Sequence[str] = ()) -> str:
    """Submit an array and return what its scheduler calls it; raises as the parts do."""
    if on == SLURM:
        return submit_array(job, sbatch)
    form = FORMS[on](job, machines)
    submit_form(form.written(Path(machines.files)), on)
    return form.name


def machines_here() -> ArrayMachines:
    """Return the machines that whoever started this process has chosen (MACHINES).

    Raises:
        TrilightError: the file cannot be read, or states no such options.
    """
    name = os.environ.get(MACHINES)
    if not name:
        return ArrayMachines()
    try:
        record = json.loads(Path(name).read_bytes())
    except (OSError, ValueError) as error:
        raise TrilightError(
            f"{MACHINES}: {name} cannot be read ({error}); expected a file of JSON with options of "
            'machines, such as {"where": "a-job-queue", "cores": 8}.'
        ) from error
    return from_record(ArrayMachines, record)
