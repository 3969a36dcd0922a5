"""`trilight train`: trains a preset on the shards of a dataset, alone or under torchrun."""

import dataclasses
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from rich.progress import TaskID

from infra.cli.console import Bars, console, next_step, note, print_rows, suggest_look
from infra.cli.options import command
from infra.cli.overrides import BaseSettings, merge_overrides, run_record
from infra.run_record import tensorboard_command
from infra.torch_library import require_torch
from infra.train_options import TrainOptions
from storage.errors import TrilightError
from storage.installation import child_environment
from storage.settings.overrides import option_words
from train.presets import scale_intervals, training_preset
from train.progress import TrainProgress
from train.settings import TrainSettings, WatchSettings

if TYPE_CHECKING:
    from train.run_training import TrainResult


class _BarProgress(TrainProgress):
    """Progress of a run as a bar, with a line for each validation."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID = bars.add_task("steps", total=None, start=False, note="")
        self._first_step = 0

    def note(self, text: str) -> None:
        note(text)

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

    def report_validation(self, *, step: int, scores: Mapping[str, float]) -> None:
        console.print(
            f"step {step}: validation log L1 {scores['log_l1']:.4f}, median "
            f"{scores['psnr_log_db_median']:.2f} dB log, {scores['psnr_linear_db_median']:.2f} dB "
            "linear"
        )

    def report_interrupt(self, times: int) -> None:
        if times == 1:
            console.print(
                "Stopping after this step and saving. Press Ctrl-C again to end without saving."
            )
            return
        self._bars.stop()
        _end("ended at once", 130)

    def report_hang(self, text: str) -> None:
        self._bars.stop()
        _end(text, 1)


def _end(text: str, status: int) -> NoReturn:
    """End a process whose main thread may be in a call that does not return."""
    sys.stderr.write(f"\ntrilight: {text}; --resume goes on from the last checkpoint.\n")
    sys.stderr.flush()
    os._exit(status)


@command("run")
def train(options: TrainOptions, watched: WatchSettings, base: BaseSettings) -> None:
    if base.is_given:
        changes = merge_overrides(
            training_preset(options.run), base, run_record(base), options.changes
        )
        options = dataclasses.replace(options, changes=changes)
    settings = options.settings()  # without torch, so that mistakes are named at once
    if options.processes > 1:  # torchrun starts this command once for each process
        if "RANK" in os.environ:
            raise TrilightError(
                f"--processes is {options.processes} under torchrun, which sets their number; "
                "omit it."
            )
        words = [*options.command(), *option_words(watched)]
        words += ["--json"] if console.quiet else []
        os.execve(words[0], words, child_environment())
    if os.environ.get("RANK", "0") == "0":
        _announce(options, settings)
    result = _run_training(options, settings, watched)
    if result is None:
        return
    if console.quiet:
        sys.stdout.write(result.folder.summary.read_text())
    _report(result, options.data)


def _run_training(
    options: TrainOptions, settings: TrainSettings, watched: WatchSettings
) -> "TrainResult | None":
    """Train by `train.run_training.run_training`; imports torch, which takes seconds."""
    require_torch("train")
    from train.loop.distributed import join_processes
    from train.loop.interrupts import Stopped
    from train.run_training import run_training

    with join_processes(options.device) as crew, Bars() as bars:
        try:
            return run_training(
                settings,
                data=list(options.data),
                out=Path(options.place),
                start=options,
                workers=options.workers,
                watched=watched,
                dist_context=crew,
                progress=_BarProgress(bars),
            )
        except Stopped as stopped:
            if crew.world_size > 1:  # torchrun's own arguments are not known here
                raise
            typed = [part for part in sys.argv[1:] if part != "--resume"]
            resume = [] if options.restartable else ["--resume"]
            command = shlex.join(["trilight", *typed, *resume])
            raise Stopped(stopped.step, command) from stopped


def _announce(options: TrainOptions, settings: TrainSettings) -> None:
    """Print the start or the continuation of a run, before torch is imported."""
    if options.continues_run:  # how, the checkpoint says
        console.print(f"Run {settings.run} goes on. Loading torch and the checkpoint ...")
        return
    if (steps := options.steps) is not None:
        shorter = scale_intervals(training_preset(options.run), steps, options.changes)
        if shorter:
            text = ", ".join(f"{name}={value}" for name, value in shorter.items())
            console.print(f"In proportion to {steps} steps: {text}")
    console.print(
        f"Run {settings.run}: {settings.num_steps} steps of {settings.scenes_per_step} scenes at "
        f"{settings.resolution} pixels. Loading torch and the data ..."
    )


def _report(result: "TrainResult", data: Sequence[str]) -> None:
    rows = [
        (
            "training loss",
            f"{result.loss_at_start:.4f} at the start, {result.loss_at_end:.4f} at end",
        ),
        *_validation_rows(result),
        ("steps", f"{result.num_steps}, of which {result.skipped_steps} not finite and skipped"),
        *(("left out", message) for message in result.unusable),
        *(
            ("changed", f"{event.name} from {event.before} to {event.after} at step {event.step}")
            for event in result.history
            if event.kind == "meaning"
        ),
        ("wall time", f"{result.seconds / 60:.1f} min"),
        ("weights", str(result.folder.weights)),
    ]
    print_rows("Training finished", rows)
    sheet = "" if result.scores is None else f"Look at {result.folder.sheet}\n"
    suggest_look(f"{sheet}Curves and pictures: {tensorboard_command(result.folder.root)}")
    if result.scores is not None:
        named = [word for each in data for word in ("--data", each)]
        next_step(["evaluate", str(result.folder.root), *named, "--split", "validation"])


def _validation_rows(result: "TrainResult") -> list[tuple[str, str]]:
    scores = result.scores
    rival = result.median_scores
    lead = result.lead
    if scores is None or rival is None or lead is None:
        return [("validation", "none: the data has no validation split")]
    # a median picture without any error allows no percentage
    unit, form = (rival["log_l1"], ".1%") if rival["log_l1"] else (1.0, ".4f")
    ahead = f"{lead.log_l1 / unit:+{form}}"
    chance = "one scene" if lead.error is None else f"chance {2 * lead.error / unit:{form}}"
    verdict = "beats it" if result.beats_median else "is not shown to beat it"
    return [
        (
            "validation log L1",
            f"{scores['log_l1']:.4f}; the median picture of the training views scores "
            f"{rival['log_l1']:.4f}: the network {verdict} ({ahead}, {chance})",
        ),
        (
            "validation PSNR",
            f"median {scores['psnr_log_db_median']:.2f} dB log "
            f"({rival['psnr_log_db_median']:.2f}), {scores['psnr_linear_db_median']:.2f} dB linear "
            f"({rival['psnr_linear_db_median']:.2f})",
        ),
    ]
