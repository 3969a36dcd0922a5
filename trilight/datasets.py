"""Datasets from Python: generate them."""

from typing import TYPE_CHECKING

from pipeline.generation.dataset_order import DatasetOrder

if TYPE_CHECKING:
    from pipeline.generation.run import Outcome


def generate(order: DatasetOrder) -> "Outcome":
    """Generate a dataset, or its missing scenes, as `trilight generate` does.

    The call may be stopped at any time; the same order resumes and gives the same dataset digest.

    Args:
        order: preset, folder, number of scenes: the options of the command line.

    Raises:
        TrilightError: an error that the user can fix; finished scenes are safe.
    """
    from pipeline.executors.threads import ThreadRunner
    from pipeline.generation.pipeline import make_dataset

    return make_dataset(order, ThreadRunner())
