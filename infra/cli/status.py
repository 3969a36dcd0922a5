"""`trilight status`: prints the progress of a dataset, from its files alone."""

import dataclasses
import time
from typing import Annotated

from infra.cli.console import (
    command_line,
    console,
    duration,
    next_step,
    print_json,
    print_rows,
    suggest_look,
)
from infra.cli.options import command
from pipeline.generation.generate_options import CorePrice
from storage.aliases import PRESET_ALIASES, name_for_people
from storage.dataset.progress import DatasetStatus, missing_shards, read_status
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class StatusOptions:
    """Dataset."""

    dataset: str
    """Dataset, a folder or a URL."""
    missing: bool = False
    """Print only the missing shards' numbers, such as 0-3,7, for schedulers."""
    shards_per_task: Annotated[int, Within(1, 10**6, unit="shards")] = 1
    """Number of shards of a task; --missing then prints numbers of tasks."""
    lines: bool = False
    """Print missing shards as ranges A:B, one a line, for generate --range."""

    def __post_init__(self) -> None:
        if self.shards_per_task != 1 and not self.missing:
            raise TrilightError(
                f"--shards-per-task is {self.shards_per_task}; expected it only with --missing."
            )
        if self.lines and not self.missing:
            raise TrilightError("--lines is given; expected it only with --missing.")


@command("dataset")
def status(options: StatusOptions, core: CorePrice) -> None:
    if options.missing:
        _print_missing(options)
        return
    progress = read_status(options.dataset)
    cost = None if progress.core_hours is None else progress.core_hours * core.price
    print_json({**dataclasses.asdict(progress), "next": _next(progress), "cost_usd": cost})
    objects = f"{progress.objects_done} of {progress.objects_planned}"
    rows = [
        *([("objects", objects)] if progress.objects_done < progress.objects_planned else []),
        ("shards", f"{progress.shards_done} of {progress.shards_planned}"),
        ("scenes", f"{progress.scenes_done} of {progress.scenes_planned}"),
        *([("given up", f"{progress.scenes_given_up} scenes")] if progress.scenes_given_up else []),
        ("views", f"{progress.scenes_done * progress.num_views}"),
        *_rate_rows(progress),
        *(
            ("rejected", f"{count} x {stage}: {reason}")
            for stage, reason, count in progress.failures
        ),
        ("dataset digest", progress.digest if progress.finished else "known once it is finished"),
    ]
    if cost is not None:
        rows.append(("cost so far", f"{progress.core_hours:.2f} core-hours, {cost:.2f} USD"))
    preset = name_for_people(progress.build, PRESET_ALIASES)
    print_rows(f"{progress.display_name}: {preset}, {_state(progress)}", rows)
    if progress.next_words:
        next_step(progress.next_words, recorded=progress.extensions)
    else:
        suggest_look(_next(progress))


def _print_missing(options: StatusOptions) -> None:
    each = options.shards_per_task
    tasks = sorted({shard // each for shard in missing_shards(options.dataset)})
    ranges = [f"{task * each}:{(task + 1) * each}" for task in tasks]
    array = number_ranges(tasks)
    print_json({"missing": tasks, "array": array, "shards": ranges, "shards_per_task": each})
    if tasks:
        console.print("\n".join(ranges) if options.lines else array, soft_wrap=True)


def _next(progress: DatasetStatus) -> str:
    if progress.next_words:
        return command_line(progress.next_words, progress.extensions)
    return (
        f"To resume: trilight generate {name_for_people(progress.build, PRESET_ALIASES)} --scenes "
        f"{progress.scenes_planned}, with the same other options as before."
    )


def _state(progress: DatasetStatus) -> str:
    if not progress.finished:
        return "unfinished; a process is making it now" if progress.at_work else "unfinished"
    lost = progress.shards_lost
    return f"finished; {lost} shard{'s' * (lost > 1)} missing" if lost else "finished"


def _rate_rows(progress: DatasetStatus) -> list[tuple[str, str]]:
    rows = []
    if progress.views_per_hour is not None and progress.remaining_s is not None:
        remaining = f"{duration(progress.remaining_s)} left at that rate"
        rows.append(("rate", f"{progress.views_per_hour:.0f} views an hour; {remaining}"))
    if progress.last_scene_unix_s is not None and not progress.finished:
        ago = max(0.0, time.time() - progress.last_scene_unix_s)
        rows.append(("last scene", f"{duration(ago)} ago"))
    return rows
