"""`trilight improve`: rounds of generate, train and judge, each drawing what teaches most."""

from functools import partial

from infra.cli.console import (
    console,
    first_words,
    look_at,
    next_step,
    print_json,
    print_rows,
    print_table,
)
from infra.cli.options import Shown, command
from infra.improve.local import train_here
from infra.improve.order import ImproveOrder
from infra.improve.report import picture_of, rows_of, summary_of
from infra.improve.rounds import LoopWorkers
from infra.improve.rounds import improve as run_rounds
from infra.improve.state import Rounds
from infra.torch_library import require_torch
from pipeline.executors.registry import find_executor
from pipeline.making.dataset_order import DatasetOrder


@command("build")
def improve(order: ImproveOrder, shown: Shown) -> None:
    first_words(
        f"{order.rounds} rounds of {order.build} and {order.run}, into {order.out}",
        silent=shown.json,
    )
    require_torch("improve")

    def make(dataset: DatasetOrder) -> object:
        return find_executor("threads", None, dataset.workers).make(dataset, None)

    def begins(number: int, what: str) -> None:
        if not shown.json:
            console.print(f"Round {number} of {order.rounds}: {what}")

    found = run_rounds(
        order, LoopWorkers(make=make, train=partial(train_here, quiet=shown.json), begins=begins)
    )
    rounds = Rounds(order)
    rows = rows_of(rounds, found)
    if shown.json:
        print_json({"out": order.out, "rounds": len(found), "strata": rows})
        return
    last = [row for row in rows if row["round"] == str(len(found))]
    print_table(
        f"Round {len(found)}", [{k: v for k, v in row.items() if k != "round"} for row in last]
    )
    print_rows("Closed loop", summary_of(found))
    look_at(f"Read {order.root / 'improve.md'}, look at {picture_of(rounds)}")
    run = str(order.root / "run")
    next_step(["inspect", run], ["evaluate", run, "--data", str(rounds.dataset(1))])
