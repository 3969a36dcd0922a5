"""`trilight revisit`: makes a new dataset from the scenes of a finished one."""

from infra.cli.changes import Shared
from infra.cli.console import first_words
from infra.cli.dataset_changes import with_shared
from infra.cli.generate import ExecutorOptions, make
from infra.cli.options import OutputOptions, command
from pipeline.making.revisit_order import Revisit, revisit_order


@command("dataset")
def revisit(options: Revisit, runner: ExecutorOptions, output: OutputOptions) -> None:
    first_words(f"Reading {options.dataset}", silent=output.json)
    order = with_shared(revisit_order(options), Shared(like=options.dataset))
    make(order, runner, output)
