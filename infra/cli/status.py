"""`trilight status` and `verify`: what is there of a dataset, and whether it is right."""

import dataclasses
import sys
import time
from typing import Annotated

from infra.cli.console import (
    Bars,
    command_line,
    console,
    duration,
    first_words,
    next_step,
    print_json,
    print_result,
    print_rows,
    suggest_look,
)
from infra.cli.options import command
from pipeline.generation.generate_options import CorePrice
from storage.aliases import PRESET_ALIASES, name_for_people
from storage.dataset.dataset import open_dataset
from storage.dataset.manifest import derivation_of, num_planned
from storage.dataset.progress import (
    DatasetStatus,
    missing_shards,
    read_asked,
    read_status,
    value_of,
)
from storage.dataset.verify import Verification, verify_dataset
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.remote.url import RemoteUrl, parse_url, safe_url
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
    record = {**dataclasses.asdict(progress), "next": _next(progress), "cost_usd": cost}
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
    print_result(f"{progress.display_name}: {preset}, {_state(progress)}", rows, record)
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


@checked()
class VerifyOptions:
    """Dataset and checks."""

    dataset: str
    """Dataset, a folder or a URL."""
    fast: bool = False
    """Check sizes and counts only."""
    repair: bool = False
    """Make missing and bad shards again, and check again."""
    objects: str | None = None
    """Source of objects for --repair; by default that of the generate command."""
    scenes_from: str | None = None
    """Folder of the dataset's scene files, for --repair; by default none."""


@command("dataset")
def verify(options: VerifyOptions) -> None:
    first_words(f"Verifying {safe_url(options.dataset)}")
    verification = _verify(options.dataset, fast=options.fast)
    if options.repair and verification.bad_shards and verification.is_finished:
        from infra.repair import repair as make_anew  # slow: the whole pipeline

        _report(verification, fast=options.fast)
        first_words("Repairing the named shards")
        make_anew(
            options.dataset,
            verification.bad_shards,
            objects=options.objects,
            scenes_from=options.scenes_from,
        )
        verification = _verify(options.dataset, fast=options.fast)
    manifest = verification.manifest
    print_json(
        {
            "bad_shards": list(verification.bad_shards),
            "dataset_digest": manifest.dataset_digest,
            "finished": verification.is_finished,
            "problems": list(verification.problems),
            "samples": manifest.num_samples,
            "scenes_planned": manifest.num_scenes,
            "shards": len(manifest.shards),
            "shards_planned": num_planned(manifest),
        }
    )
    _report(verification, fast=options.fast)
    _print_repair(verification, options.dataset)
    if verification.problems or not verification.is_finished:
        sys.exit(1)


def _verify(dataset: str, *, fast: bool) -> Verification:
    opened = open_dataset(dataset)
    with Bars() as bars:
        total = len(opened.manifest.shards) or None
        task = bars.add_task("shards", total=total, note="")
        return verify_dataset(opened, fast=fast, shard_done=lambda _: bars.advance(task))


def _print_repair(verification: Verification, dataset: str) -> None:
    """Print how to complete or repair a dataset, depending on how it was made."""
    generate_command = read_asked(open_dataset(dataset))
    is_remote = isinstance(parse_url(dataset, what="dataset"), RemoteUrl)
    derivation = derivation_of(verification.manifest.settings)
    if not verification.is_finished:
        if generate_command is not None:
            next_step(
                (*generate_command, "--out", dataset), recorded=verification.manifest.extensions
            )
        else:
            suggest_look("To resume, run the trilight generate command that began it.")
    elif not verification.problems:
        return
    elif not verification.bad_shards:
        suggest_look(
            "No shard was found wrong. Verify again what could not be read. A document that was "
            "edited is written anew by the command that made the dataset (keep notes in a file of "
            "your own). Restore other named files from a copy."
        )
    elif is_remote:
        suggest_look(
            "Delete the named shards there and run trilight generate again, or copy them again "
            "from the folder that the dataset was copied from."
        )
    elif derivation is not None:
        suggest_look(f"Make it again from its sources: trilight shards {derivation.operation}.")
    else:
        sources = ("--objects", "--scenes-from")
        values = [(option, value_of(generate_command or (), option)) for option in sources]
        named = [word for option, value in values if value for word in (option, value)]
        words = ("verify", dataset, "--repair", *named)
        next_step(words, recorded=verification.manifest.extensions)


def _report(verification: Verification, *, fast: bool) -> None:
    manifest = verification.manifest
    shards = f"{len(manifest.shards)}"
    title = "Verified"
    if not verification.is_finished:
        shards += f" of {num_planned(verification.manifest)}"
        title = "Unfinished; everything present is valid"
    rows = [
        ("dataset digest", manifest.dataset_digest),
        ("shards", f"{shards}, {manifest.num_bytes / 1e6:.1f} MB"),
        ("scenes", f"{verification.manifest.num_samples} of {manifest.num_scenes} planned"),
        ("checked", "sizes and counts" if fast else "hashes, members, laws, pictures, splits"),
        *(("wrong", problem) for problem in verification.problems),
    ]
    print_rows("Does not match its manifest" if verification.problems else title, rows)
