"""`trilight generate`, `plan` and `revisit`: datasets of objects, scene files or other datasets.

Progress bars read the files of the dataset, so that they serve any executor. The cost of a dataset
is predicted from a few scenes measured on this machine.
"""

import contextlib
import dataclasses
import itertools
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from infra.cli.console import (
    Bars,
    duration,
    first_words,
    next_step,
    note,
    print_json,
    print_result,
    print_rows,
)
from infra.cli.options import command
from infra.cli.overrides import BaseSettings, with_base_settings
from infra.cli.process_exit import temporary_folder
from pipeline.executors.registry import find_executor
from pipeline.generation.dataset_writer import require_its_extensions
from pipeline.generation.generate_options import (
    CorePrice,
    GenerateOptions,
    RevisitOptions,
    generate_words,
    to_generate_options,
)
from pipeline.objects.licences import USER_PROVIDED
from storage.dataset.layout import DatasetFolder, dataset_folder
from storage.dataset.manifest import read_head
from storage.dataset.progress import read_progress
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.records.objects import count_by_reason, read_failures, read_objects_lock
from storage.settings.described import checked
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from infra.planning import Interval, Prediction
    from pipeline.generation.generation_run import Outcome

_POLL_S = 0.5
_MAX_NOTES = 20
"""Maximum number of notes that are printed."""

_RUN = "tiny"
"""Training preset that the next step names."""


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
def generate(options: GenerateOptions, base: BaseSettings, runner: ExecutorOptions) -> None:
    require_its_extensions(options.folder)
    make(with_base_settings(options, base), runner)


def make(options: GenerateOptions, runner: ExecutorOptions) -> None:
    """Make a dataset and print the result; raises TrilightError."""
    folder = options.folder
    started = time.monotonic()
    first_words(f"Making {folder.display_name} with the preset {options.build}")
    executor = find_executor(runner.runner, runner.address, options.workers)
    from infra.planning import describe_run  # slow: every stage
    from pipeline.generation.generation_run import choose_dataset_variant

    if text := describe_run(options, folder):
        first_words(text)
    if text := choose_dataset_variant(options, folder).note:
        note(f"{text}; see trilight doctor")
    ended = threading.Event()
    with Bars() as bars:
        watcher = threading.Thread(target=_watch, args=(folder, bars, ended), daemon=True)
        watcher.start()
        try:
            outcome = executor.make(options, runner.address)
        finally:
            ended.set()
            watcher.join()
    report(folder, outcome, time.monotonic() - started)


def _watch(folder: DatasetFolder, bars: Bars, ended: threading.Event) -> None:
    """Draw downloads, objects and views until their maker has ended.

    A view in progress counts as a fraction.
    """
    downloads, objects, views = (
        bars.add_task(name, total=None, note="") for name in ("download", "objects", "views")
    )
    already: float | None = None
    most = 0.0
    waits = not folder.contact_sheet.exists()
    last = False
    while not last:
        last = ended.wait(_POLL_S)
        with contextlib.suppress(OSError, ValueError):  # a file may vanish between two looks
            now = read_progress(folder)
            to_load = now.downloads_planned or None
            bars.update(downloads, completed=now.downloads_done, total=to_load)
            bars.update(objects, completed=now.objects_done, total=now.objects_planned or None)
            if now.scenes_planned and now.objects_done >= now.objects_planned:
                if already is None:  # rate and ETA leave out the views of earlier runs
                    already = now.views_done
                    bars.reset(views)
                total = (now.scenes_planned - now.scenes_given_up) * now.num_views - already
                # the bar does not go back where a scene begins again
                most = min(max(most, now.views_done - already), total)
                given_up = f", {now.scenes_given_up} given up" if now.scenes_given_up else ""
                earlier = f", {already:.0f} views were there" if already else ""
                text = f"scenes {now.scenes_done} of {now.scenes_planned}{given_up}{earlier}"
                bars.update(views, completed=most, total=total, note=text)
        if waits and folder.contact_sheet.exists():
            waits = False
            bars.console.print(f"First pictures: {folder.contact_sheet}", soft_wrap=True)


def report(folder: DatasetFolder, outcome: "Outcome", seconds: float) -> None:
    """Print the result and the next commands."""
    rejected = count_by_reason([*read_failures(folder.failures), *outcome.failures])
    statistics = outcome.statistics
    sizes = {}
    if statistics is not None:
        sizes = {
            "scenes": statistics.num_scenes,
            "views": statistics.num_views,
            "bytes": statistics.num_bytes,
        }
    print_json(
        {
            "out": folder.display_name,
            "dataset_digest": outcome.digest,
            "finished": bool(outcome.digest),
            "shards": outcome.num_shards,
            "shards_planned": outcome.num_shards_planned,
            "objects_found": outcome.num_objects_found,
            "objects_used": outcome.num_objects_used,
            "notes": list(outcome.notes),
            "scenes_given_up": outcome.num_scenes_given_up,
            "rejections": [list(row) for row in rejected],
            "seconds": round(seconds, 1),
            **sizes,
        }
    )
    used = f"{outcome.num_objects_used} of {outcome.num_objects_found}"
    counts = Counter(entry.licence for entry in read_objects_lock(folder.objects_lock))
    licences = ", ".join(f"{name} ({count})" for name, count in counts.most_common())
    licences = licences.replace(USER_PROVIDED, f"{USER_PROVIDED}, taken as yours to use")
    rows = [("objects used", used), ("licenses", licences)]
    rows += statistics.lines() if statistics else []
    if outcome.num_scenes_given_up:
        rows.append(("scenes given up", str(outcome.num_scenes_given_up)))
    rows += [("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in rejected]
    if statistics:
        looked_at = (folder.contact_sheet, folder.report, folder.card)
        rows.append(("dataset digest", outcome.digest))
        rows.append(("look at", ", ".join(_shown_path(folder, path) for path in looked_at)))
    rows += [("wall time", f"{seconds:.0f} s"), ("shards, manifest", folder.display_name)]
    if rejected:
        later = "" if statistics else ", once the dataset is finished"
        rows.append(("why rejected", f"{_shown_path(folder, folder.failures)}{later}"))
    for text in outcome.notes[:_MAX_NOTES]:
        note(text)
    if (more := len(outcome.notes) - _MAX_NOTES) > 0:
        note(f"{more} more; --json has all")
    if statistics is not None:
        print_rows("Dataset finished", rows)
        next_step(*_next_steps(folder, statistics))
    elif outcome.digest:
        print_rows("Dataset finished by another machine, which writes its documents", rows)
        next_step(["verify", folder.display_name])
    else:
        counts_text = f"{outcome.num_shards} of {outcome.num_shards_planned} shards are there"
        print_rows(f"Range finished; {counts_text}", rows)
        next_step(["status", folder.display_name])


def _next_steps(folder: DatasetFolder, statistics: Statistics) -> Iterator[Sequence[str]]:
    """Yield the next commands for a finished dataset.

    Training is one where the dataset has such scenes that fit, and torch is installed.
    """
    from train.presets import training_preset  # late, so that the first line is printed sooner

    yield ("verify", folder.display_name)
    yield ("view", folder.display_name)
    manifest = read_head(folder.manifest)
    run = training_preset(_RUN)
    fits = manifest.settings["renders"]["resolution"] % run.resolution == 0
    has_views = manifest.num_views >= run.views_per_scene and find_spec("torch") is not None
    if statistics.scenes_by_split.get("train") and fits and has_views:
        yield ("train", _RUN, "--data", folder.display_name)


def _shown_path(folder: DatasetFolder, path: Path) -> str:
    """Return the path or URL of a file of a dataset, for people."""
    return f"{folder.display_name}/{path.relative_to(folder.root)}"


@command("dataset")
def revisit(options: RevisitOptions, runner: ExecutorOptions) -> None:
    first_words(f"Reading {options.dataset}")
    made = with_base_settings(to_generate_options(options), BaseSettings(like=options.dataset))
    make(made, runner)


@checked()
class PlanOptions:
    """Measurement and machines."""

    samples: Annotated[int, Within(4, 10_000, unit="scenes")] = 12
    """Number of scenes to measure."""
    cores: Annotated[int, Within(1, 10**7, unit="cores")] = 64
    """Total number of cores of all machines."""


@command("build")
def plan(
    options: GenerateOptions,
    base: BaseSettings,
    plan_options: PlanOptions,
    core: CorePrice,
) -> None:
    if (options.scenes_from, options.revisits, options.shards) != (None,) * 3:
        raise TrilightError(
            "plan: --scenes-from, --revisits or --range was given; expected none of them, since a "
            "whole dataset of new scenes is predicted."
        )
    options = with_base_settings(options, base)
    samples = plan_options.samples
    first_words(f"Measuring {samples} scenes of {options.build}")
    from infra.planning import measure_scenes, predict_cost  # slow: every stage

    with Bars() as bars, temporary_folder("trilight-plan-") as place:
        task = bars.add_task("scenes", total=samples, note="")
        measured = measure_scenes(options, samples, place, lambda: bars.advance(task))
    cores = plan_options.cores
    prediction = predict_cost(measured, options, cores=cores, usd_per_core_hour=core.price)
    title = f"{options.build}, {prediction.num_scenes} scenes, predicted from {samples}"
    record = dataclasses.asdict(prediction)
    print_result(f"{title} (90 % intervals)", _rows(prediction, cores), record)
    for text in prediction.notes:
        note(text)
    out = options.place  # or with a number added, where a dataset is there
    numbered = (out if number < 2 else f"{out}-{number}" for number in itertools.count(1))
    free = next(name for name in numbered if not dataset_folder(name).manifest.exists())
    next_step((*generate_words(options), "--out", free))


def _rows(prediction: "Prediction", cores: int) -> list[tuple[str, str]]:
    def to_hours(interval: "Interval", cores: int = 1) -> str:
        return interval.to_text(lambda hours: duration(3600 * hours / cores))

    local_cores = available_cores()
    tasks = f"{prediction.num_tasks}, {prediction.task_minutes:.1f} minutes each"
    return [
        ("core-hours", prediction.core_hours.to_text("{:,.2f}".format)),
        (f"on {cores} cores", to_hours(prediction.hours)),
        (f"on the {local_cores} cores here", to_hours(prediction.core_hours, local_cores)),
        ("USD", prediction.usd.to_text("{:,.2f}".format)),
        ("GB", prediction.gigabytes.to_text("{:,.2f}".format)),
        ("shards", f"{prediction.num_shards} of up to {prediction.scenes_per_shard} scenes"),
        ("a shard", prediction.shard_hours.to_text("{:,.2f} core-hours".format)),
        ("Prefect's task runs", tasks),
        ("Prefect's database", f"{prediction.database_mb:.1f} MB"),
        ("manifest.json", f"{prediction.manifest_mb:.1f} MB"),
    ]
