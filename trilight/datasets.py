"""Datasets from Python: generate them."""

from typing import TYPE_CHECKING

from pipeline.generation.generate_options import GenerateOptions

if TYPE_CHECKING:
    from pipeline.generation.generation_run import Outcome


def generate(options: GenerateOptions) -> "Outcome":
    """Generate a dataset, or its missing scenes, as `trilight generate` does.

    The call may be stopped at any time; the same options resume and give the same dataset digest.

    Args:
        options: preset, folder, number of scenes: the options of the command line.

    Raises:
        TrilightError: an error that the user can fix; finished scenes are safe.
    """
    from pipeline.executors.threads import ThreadRunner
    from pipeline.generation.pipeline import make_dataset

    return make_dataset(options, ThreadRunner())
