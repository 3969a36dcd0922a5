"""`trilight status`: how far a dataset is, from its files alone."""

import dataclasses
import time
from typing import Annotated

from infra.cli.console import (
    command_line,
    console,
    duration,
    look_at,
    next_step,
    print_json,
    print_rows,
)
from infra.cli.options import Shown, command
from pipeline.making.price import CorePrice
from storage.dataset.progress import DatasetStatus, missing_shards, read_status
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class StatusOrder:
    """The dataset."""

    dataset: str
    """The dataset, a folder or a URL."""
    missing: bool = False
    """Print only the numbers of the missing shards, such as 0-3,7, and nothing if none is: what a
    scheduler needs to start them again."""
    shards_per_task: Annotated[int, Within(1, 10**6, unit="shards")] = 1
    """With --missing: print instead the numbers of the tasks that make so many shards each."""
    lines: bool = False
    """With --missing: print a range A:B of shards a line instead, as --shards of generate takes
    it."""

    def __post_init__(self) -> None:
        if self.shards_per_task != 1 and not self.missing:
            raise TrilightError(
                f"--shards-per-task is {self.shards_per_task}; expected it only with --missing."
            )
        if self.lines and not self.missing:
            raise TrilightError("--lines is given; expected it only with --missing.")


@command("dataset")
def status(watched: StatusOrder, core: CorePrice, shown: Shown) -> None:
    if watched.missing:
        _print_missing(watched, as_json=shown.json)
        return
    found = read_status(watched.dataset)
    cost = None if found.core_hours is None else found.core_hours * core.price
    if shown.json:
        row = {**dataclasses.asdict(found), "next": _next(found), "cost_usd": cost}
        print_json(row)
        return
    rows = [
        ("shards", f"{found.shards_done} of {found.shards_planned}"),
        ("scenes", f"{found.scenes_done} of {found.scenes_planned}"),
        *([("given up", f"{found.scenes_given_up} scenes")] if found.scenes_given_up else []),
        ("views", f"{found.scenes_done * found.num_views}"),
        *_speed(found),
        *(("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in found.failures),
        ("dataset digest", found.digest if found.finished else "known once it is finished"),
    ]
    if cost is not None:
        rows.append(("cost so far", f"{found.core_hours:.2f} core-hours, {cost:.2f} USD"))
    title = "finished" if found.finished else "unfinished"
    print_rows(f"{found.shown}: {found.build}, {title}", rows)
    if found.next_words:
        next_step(found.next_words, recorded=found.extensions)
    else:
        look_at(_next(found))


def _print_missing(watched: StatusOrder, *, as_json: bool) -> None:
    each = watched.shards_per_task
    tasks = sorted({shard // each for shard in missing_shards(watched.dataset)})
    ranges = [f"{task * each}:{(task + 1) * each}" for task in tasks]
    if as_json:
        print_json(
            {
                "missing": tasks,
                "array": number_ranges(tasks),
                "shards": ranges,
                "shards_per_task": each,
            }
        )
    elif watched.lines:
        console.file.writelines(f"{shards}\n" for shards in ranges)
    elif tasks:
        console.print(number_ranges(tasks), soft_wrap=True)


def _next(found: DatasetStatus) -> str:
    if found.next_words:
        return command_line(found.next_words, found.extensions)
    return (
        f"To resume: trilight generate {found.build} --scenes {found.scenes_planned}, with the "
        "same other options as before."
    )


def _speed(found: DatasetStatus) -> list[tuple[str, str]]:
    rows = []
    if found.views_per_hour is not None and found.remaining_s is not None:
        left = f"{duration(found.remaining_s)} left at that rate"
        rows.append(("rate", f"{found.views_per_hour:.0f} views an hour; {left}"))
    if found.last_scene_unix_s is not None and not found.finished:
        ago = max(0.0, time.time() - found.last_scene_unix_s)
        rows.append(("last scene", f"{duration(ago)} ago"))
    return rows
