"""`trilight generate`: makes a dataset from objects or from scene files."""

import time

from infra.cli.changes import BaseSettings, with_base_settings
from infra.cli.console import first_words, note
from infra.cli.generate_progress import show_progress
from infra.cli.generate_report import report
from infra.cli.options import OutputOptions, command
from pipeline.executors.registry import find_executor
from pipeline.generation.dataset_order import DatasetOrder
from storage.dataset.layout import dataset_folder
from storage.settings.described import checked


@checked()
class ExecutorOptions:
    """Executor."""

    runner: str = "threads"
    """Executor of the tasks: threads, slurm, prefect, dask, or your own (--extend). slurm: this
    command is one task of a job array. prefect: a flow run at PREFECT_API_URL. dask: the workers of
    a cluster."""
    address: str | None = None
    """Address of the dask scheduler, such as tcp://host:8786; by default none."""


@command("build")
def generate(
    order: DatasetOrder, base: BaseSettings, runner: ExecutorOptions, output: OutputOptions
) -> None:
    make(with_base_settings(order, base), runner, output)


def make(order: DatasetOrder, runner: ExecutorOptions, output: OutputOptions) -> None:
    """Make a dataset and print the result; raises TrilightError."""
    folder = dataset_folder(order.place)
    started = time.monotonic()
    first_words(f"Making {folder.display_name} with the build {order.build}", silent=output.json)
    executor = find_executor(runner.runner, runner.address, order.workers)
    from infra.planning import describe_run  # slow: every stage
    from pipeline.generation.run import choose_dataset_variant

    if not output.json and (text := describe_run(order, folder)):
        first_words(text)
    if (text := choose_dataset_variant(order, folder).note) and not output.json:
        note(f"{text}; see trilight doctor")
    with show_progress(folder, silent=output.json):
        outcome = executor.make(order, runner.address)
    report(folder, outcome, time.monotonic() - started, as_json=output.json)
