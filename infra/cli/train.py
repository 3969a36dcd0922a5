"""`trilight train`: a named run on the shards of a dataset, alone or under torchrun."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress as Bars
from rich.progress import TaskID
from rich.text import Text

from infra.cli.changes import parse_changes
from infra.cli.console import console, print_rows, progress_bars
from storage.errors import TrilightError

if TYPE_CHECKING:
    from train.result import TrainResult


class _BarProgress:
    """Shows a run as a progress bar, and each validation as a line."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID = bars.add_task("steps", total=None, start=False, note="")
        self._first_step = 0

    def noted(self, text: str) -> None:
        console.print(Text(f"Note: {text}.", style="yellow"))

    def begin(
        self, *, step: int, num_steps: int, num_parameters: int, median_scores: Mapping[str, float]
    ) -> None:
        rival = median_scores["log_l1"]
        console.print(
            f"{num_parameters / 1e6:.2f} M parameters; the median picture scores {rival:.4f} "
            "log L1 on the validation split"
        )
        self._first_step = step
        self._bars.update(self._task, total=num_steps - step)
        self._bars.start_task(self._task)

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        note = f"loss {loss:.4f}, {views_per_s:.1f} views/s"
        self._bars.update(self._task, completed=step - self._first_step, note=note)

    def validated(self, *, step: int, scores: Mapping[str, float]) -> None:
        console.print(
            f"step {step}: validation log L1 {scores['log_l1']:.4f}, median "
            f"{scores['psnr_log_db_median']:.2f} dB log, {scores['psnr_linear_db_median']:.2f} dB "
            "linear"
        )


def train(
    run: Annotated[str, typer.Argument(help="named run, such as smoke")],
    data: Annotated[
        list[str],
        typer.Option(
            help="root of a dataset, a folder or a URL; or shards, by name or pattern such as "
            "s3://b/{train,validation}-{000000..000007}.tar, and may be repeated"
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="folder of the run [runs/RUN]")] = None,
    resume: Annotated[bool, typer.Option(help="go on from the newest checkpoint")] = False,
    from_: Annotated[
        str | None,
        typer.Option("--from", help="finetune runs: run folder or checkpoint to begin with"),
    ] = None,
    lpips: Annotated[
        str | None,
        typer.Option(
            help="folder with vgg16-397923af.pth and vgg.pth, or hub to download them "
            "[$TRILIGHT_LPIPS]"
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu or cuda [cuda where there is one]")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="replace the run's number of steps")] = None,
    workers: Annotated[int, typer.Option(min=1, help="threads that decode samples")] = 1,
    skip_unusable: Annotated[
        int | None, typer.Option(min=0, help="replace up to so many damaged samples [stop at one]")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="any other setting by its name in settings.json, with its value in JSON, such as "
            "loss.perceptual=none or model.width=256; may be repeated",
        ),
    ] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Train a model; writes checkpoints, metrics.jsonl, TensorBoard curves and a sheet.

    For several processes, on one machine or many: torchrun -m infra.cli.app train ...
    """
    try:
        from train.loop.crew import join_crew
        from train.run import train_run
        from train.runs import changed_run
        from train.start import Start
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise TrilightError("train: torch is not installed; run `make setup-all`.") from error
    settings = changed_run(run, parse_changes(set_ or ()), steps=steps, most_unusable=skip_unusable)
    start = Start(resume=resume, begin_with=from_, lpips=lpips)
    with join_crew(device) as crew, progress_bars() as bars:
        result = train_run(
            settings,
            data=data,
            out=out or Path("runs") / run,
            start=start,
            crew=crew,
            workers=workers,
            progress=_BarProgress(bars),
        )
    if result is None:
        return
    if json:
        sys.stdout.write(result.folder.summary.read_text())
    else:
        _report(result)


def _report(result: "TrainResult") -> None:
    scores, rival = result.scores, result.median_scores
    better = "beats it" if result.beats_median else "does not beat it"
    rows = [
        (
            "training loss",
            f"{result.loss_at_start:.4f} at the start, {result.loss_at_end:.4f} at end",
        ),
        (
            "validation log L1",
            f"{scores['log_l1']:.4f}; the median picture of the training views scores "
            f"{rival['log_l1']:.4f}: the network {better}",
        ),
        (
            "validation PSNR",
            f"median {scores['psnr_log_db_median']:.2f} dB log "
            f"({rival['psnr_log_db_median']:.2f}), {scores['psnr_linear_db_median']:.2f} dB linear "
            f"({rival['psnr_linear_db_median']:.2f})",
        ),
        ("steps", f"{result.num_steps}, of which {result.skipped_steps} not finite and skipped"),
        *(("left out", message) for message in result.unusable),
        ("wall time", f"{result.seconds / 60:.1f} min"),
        ("weights", str(result.folder.weights)),
    ]
    print_rows("Training finished", rows)
    console.print(f"\nLook at {result.folder.sheet}", style="bold")
