"""`trilight train`: a named run on the shards of a dataset, alone or under torchrun."""

import os
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import Progress as Bars
from rich.progress import TaskID
from rich.text import Text

from infra.cli.changes import parse_changes
from infra.cli.console import console, print_rows, progress_bars
from storage.errors import TrilightError
from storage.extensions import function_name

if TYPE_CHECKING:
    from train.result import TrainResult
    from train.settings import TrainSettings


class _BarProgress:
    """Shows a run as a progress bar, and each validation as a line."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID = bars.add_task("steps", total=None, start=False, note="")
        self._first_step = 0

    def noted(self, text: str) -> None:
        console.print(Text(f"Note: {text}.", style="yellow"))

    def begin(
        self,
        *,
        step: int,
        num_steps: int,
        num_parameters: int,
        median_scores: Mapping[str, float] | None,
    ) -> None:
        rival = ""
        if median_scores is not None:
            rival = (
                f"; the median picture scores {median_scores['log_l1']:.4f} log L1 on the "
                "validation split"
            )
        console.print(f"{num_parameters / 1e6:.2f} M parameters{rival}")
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

    def interrupted(self, times: int) -> None:
        if times == 1:
            console.print("Stopping after this step, which is then saved. Again: end at once.")
            return
        self._bars.stop()
        sys.stderr.write("\ntrilight: ended at once; --resume goes on from the last checkpoint.\n")
        sys.stderr.flush()
        os._exit(130)


def train(
    run: Annotated[
        str, typer.Argument(help="named run, such as smoke, or your own FILE.py:FUNCTION")
    ],
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
    steps: Annotated[
        int | None,
        typer.Option(
            help="replace the run's number of steps; fewer shorten its warm-up and intervals"
        ),
    ] = None,
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

    For several processes, on one machine or many: torchrun -m trilight train ...
    """
    from train.runs import changed_run, typed_run  # no torch, so that mistakes are named at once
    from train.start import Start

    changes = parse_changes(set_ or ())
    named = typed_run(run)
    settings = changed_run(named, changes, steps=steps, most_unusable=skip_unusable)
    start = Start(resume=resume, begin_with=from_, lpips=lpips)
    start.check(settings)
    if os.environ.get("RANK", "0") == "0" and not json:
        _announce(settings, named, steps, changes)
    result = _trained(
        settings,
        data=data,
        out=out or Path("runs") / function_name(run),
        start=start,
        device=device,
        workers=workers,
        quiet=json,
    )
    if result is None:
        return
    if json:
        sys.stdout.write(result.folder.summary.read_text())
    else:
        _report(result)


def _trained(
    settings: "TrainSettings", *, device: str | None, quiet: bool, **rest: Any
) -> "TrainResult | None":
    """Train as train.run.train_run does; torch is imported here, which takes seconds."""
    try:
        from train.loop.crew import join_crew
        from train.loop.interrupts import Stopped
        from train.run import train_run
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise TrilightError("train: torch is not installed; run `make setup-all`.") from error
    with join_crew(device) as crew, progress_bars() as bars:
        progress = None if quiet else _BarProgress(bars)
        try:
            return train_run(settings, crew=crew, progress=progress, **rest)
        except Stopped as stopped:
            if crew.world_size > 1:  # torchrun's own arguments are not known here
                raise
            typed = [part for part in sys.argv[1:] if part != "--resume"]
            raise TrilightError(
                f"training: stopped at step {stopped.step}, nothing is lost. To go on: "
                + shlex.join(["trilight", *typed, "--resume"])
            ) from stopped


def _announce(
    settings: "TrainSettings", run: str, steps: int | None, changes: Mapping[str, Any]
) -> None:
    """Say what begins, before torch is imported."""
    from train.runs import in_proportion, named_run

    if steps is not None:
        shorter = in_proportion(named_run(run), steps, changes)
        if shorter:
            shown = ", ".join(f"{name}={value}" for name, value in shorter.items())
            console.print(f"In proportion to {steps} steps: {shown}")
    console.print(
        f"Run {settings.run}: {settings.num_steps} steps of {settings.scenes_per_step} scenes at "
        f"{settings.resolution} pixels. Loading torch and the data ..."
    )


def _report(result: "TrainResult") -> None:
    rows = [
        (
            "training loss",
            f"{result.loss_at_start:.4f} at the start, {result.loss_at_end:.4f} at end",
        ),
        *_judged(result),
        ("steps", f"{result.num_steps}, of which {result.skipped_steps} not finite and skipped"),
        *(("left out", message) for message in result.unusable),
        ("wall time", f"{result.seconds / 60:.1f} min"),
        ("weights", str(result.folder.weights)),
    ]
    print_rows("Training finished", rows)
    if result.scores is not None:
        console.print(f"\nLook at {result.folder.sheet}", style="bold")


def _judged(result: "TrainResult") -> list[tuple[str, str]]:
    scores, rival, lead = result.scores, result.median_scores, result.lead
    if scores is None or rival is None or lead is None:
        return [("validation", "none: the data has no validation split")]
    ahead = lead.log_l1 / rival["log_l1"]
    chance = "one scene" if lead.error is None else f"chance {2 * lead.error / rival['log_l1']:.1%}"
    verdict = "beats it" if result.beats_median else "is not shown to beat it"
    return [
        (
            "validation log L1",
            f"{scores['log_l1']:.4f}; the median picture of the training views scores "
            f"{rival['log_l1']:.4f}: the network {verdict} ({ahead:+.1%}, {chance})",
        ),
        (
            "validation PSNR",
            f"median {scores['psnr_log_db_median']:.2f} dB log "
            f"({rival['psnr_log_db_median']:.2f}), {scores['psnr_linear_db_median']:.2f} dB linear "
            f"({rival['psnr_linear_db_median']:.2f})",
        ),
    ]
