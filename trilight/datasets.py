"""Datasets: generate, open, read and count them."""

from typing import TYPE_CHECKING

from pipeline.generation.dataset_order import DatasetOrder
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.statistics import Statistics, dataset_statistics
from storage.records.sample import Sample

if TYPE_CHECKING:
    from pipeline.generation.run import Outcome

__all__ = [
    "Dataset",
    "DatasetOrder",
    "Outcome",
    "Sample",
    "Statistics",
    "dataset_statistics",
    "generate",
    "open_dataset",
]


def generate(order: DatasetOrder) -> "Outcome":
    """Generate a dataset, or its missing scenes, as `trilight generate` does.

    The call may be stopped at any time; the same order resumes and gives the same dataset digest.

    Args:
        order: build, folder, number of scenes: the options of the command line.

    Raises:
        TrilightError: an error that the user can fix; finished scenes are safe.
    """
    from pipeline.executors.threads import ThreadRunner
    from pipeline.generation.pipeline import make_dataset

    return make_dataset(order, ThreadRunner())


def __getattr__(name: str) -> object:
    if name != "Outcome":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pipeline.generation.run import Outcome

    return Outcome
