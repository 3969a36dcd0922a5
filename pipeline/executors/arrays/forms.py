"""The forms of an array by the name that `trilight submit` and `--runner` take."""

from collections.abc import Callable, Mapping

from pipeline.executors.arrays.aws_batch import aws_batch_form
from pipeline.executors.arrays.form import ArrayForm
from pipeline.executors.arrays.google_batch import google_batch_form
from pipeline.executors.arrays.job import ArrayJob
from pipeline.executors.arrays.kubernetes import kubernetes_form
from pipeline.executors.arrays.machines import ArrayMachines
from pipeline.executors.arrays.sky import sky_form

FORMS: Mapping[str, Callable[[ArrayJob, ArrayMachines], ArrayForm]] = {
    "kubernetes": kubernetes_form,
    "sky": sky_form,
    "aws-batch": aws_batch_form,
    "google-batch": google_batch_form,
}
