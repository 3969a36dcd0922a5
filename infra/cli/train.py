"""`trilight train`: a named run on the shards of a dataset."""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress as Bars
from rich.progress import TaskID

from infra.cli.console import console, print_json, print_rows, progress_bars
from storage.errors import TrilightError


class _BarProgress:
    """Shows a run as a progress bar, and each validation as a line."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID = bars.add_task("steps", total=None, start=False, note="")

    def begin(self, *, step: int, num_steps: int, num_parameters: int, message: str) -> None:
        self._bars.print(message)
        self._bars.update(self._task, total=num_steps - step)
        self._first = step
        self._bars.start_task(self._task)

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        note = f"loss {loss:.4f}, {views_per_s:.1f} views/s"
        self._bars.update(self._task, completed=step - self._first, note=note)

    def validated(self, *, step: int, scores: Mapping[str, float]) -> None:
        text = ", ".join(f"{name} {value:.4g}" for name, value in scores.items())
        self._bars.print(f"step {step}: validation {text}")


def train(
    run: Annotated[str, typer.Argument(help="named run, such as smoke")],
    data: Annotated[str, typer.Option(help="folder of a dataset")],
    out: Annotated[Path | None, typer.Option(help="folder of the run [runs/RUN]")] = None,
    resume: Annotated[bool, typer.Option(help="go on from the last checkpoint")] = False,
    steps: Annotated[int | None, typer.Option(help="replace the run's number of steps")] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Train a model; writes checkpoints, metrics.jsonl and a sheet of validation pictures."""
    try:
        from train.run import train_run
        from train.settings import named_run
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise TrilightError("train: torch is not installed; run `make setup-all`.") from error
    settings = named_run(run)
    if steps is not None:
        settings = dataclasses.replace(settings, num_steps=steps)
    folder = out or Path("runs") / run
    started = time.monotonic()
    with progress_bars() as bars:
        result = train_run(
            settings, data=data, out=folder, resume=resume, report=_BarProgress(bars)
        )
    if json:
        print_json(dataclasses.asdict(result) | {"seconds": time.monotonic() - started})
        return
    print_rows("Training finished", [*result.lines(), ("wall time", _minutes(started))])
    console.print(f"\nLook at {result.sheet}", style="bold")


def _minutes(started: float) -> str:
    return f"{(time.monotonic() - started) / 60:.1f} min"
