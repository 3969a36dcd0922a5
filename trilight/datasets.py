"""Datasets: made, opened, walked through and counted."""

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
    """Make a dataset, or what is missing of it, as `trilight generate` does.

    It may be stopped at any time; the same order goes on, and ends in the same dataset digest.

    Args:
        order: which build, where, how many scenes: what the command line takes as options.

    Raises:
        TrilightError: what the user can mend; what is finished is safe.
    """
    from pipeline.executors.threads import ThreadRunner
    from pipeline.generation.pipeline import make_dataset

    return make_dataset(order, ThreadRunner())


def __getattr__(name: str) -> object:
    if name != "Outcome":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pipeline.generation.run import Outcome

    return Outcome
