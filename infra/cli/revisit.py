"""`trilight revisit`: a new dataset of the scenes of a finished one."""

from infra.cli.changes import Shared
from infra.cli.console import first_words
from infra.cli.dataset_changes import with_shared
from infra.cli.generate import ExecutorChoice, make
from infra.cli.options import Shown, command
from pipeline.making.revisit_order import Revisit, revisit_order


@command("dataset")
def revisit(asked: Revisit, runner: ExecutorChoice, shown: Shown) -> None:
    first_words(f"Reading {asked.dataset}", silent=shown.json)
    order = with_shared(revisit_order(asked), Shared(like=asked.dataset))
    make(order, runner, shown)
