"""Output of `trilight generate` at its end."""

from collections import Counter
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from infra.cli.console import next_step, note, print_json, print_rows
from pipeline.objects.licences import USER_PROVIDED
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, read_head
from storage.dataset.statistics import Statistics
from storage.records.objects import count_by_reason, read_failures, read_objects_lock

if TYPE_CHECKING:
    from pipeline.generation.run import Outcome

_MAX_NOTES = 20
"""Maximum number of notes that are printed."""
_RUN = "smoke"
"""Training preset that the next step names."""


def report(folder: DatasetFolder, outcome: "Outcome", seconds: float, *, as_json: bool) -> None:
    """Print the result and the next commands."""
    rejected = count_by_reason([*read_failures(folder.failures), *outcome.failures])
    if as_json:
        _print_json(folder, outcome, rejected, seconds)
        return
    statistics = outcome.statistics
    used = f"{outcome.num_objects_used} of {outcome.num_objects_found}"
    rows = [("objects used", used), ("licences", _licences(folder))]
    rows += statistics.lines() if statistics else []
    if outcome.num_scenes_given_up:
        rows.append(("scenes given up", str(outcome.num_scenes_given_up)))
    rows += [("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in rejected]
    if statistics:
        looked_at = (folder.contact_sheet, folder.report, folder.card)
        rows.append(("dataset digest", outcome.digest))
        rows.append(("look at", ", ".join(_shown_path(folder, path) for path in looked_at)))
    rows += [
        ("wall time", f"{seconds:.0f} s"),
        ("shards, manifest", folder.display_name),
    ]
    if rejected:
        later = "" if statistics else ", once the dataset is finished"
        rows.append(("why rejected", f"{_shown_path(folder, folder.failures)}{later}"))
    _print_notes(outcome.notes)
    if statistics is None and outcome.digest:
        print_rows("Dataset finished by another machine, which writes its documents", rows)
        next_step(["verify", folder.display_name])
        return
    if statistics is None:
        progress = f"{outcome.num_shards} of {outcome.num_shards_planned} shards are there"
        print_rows(f"Range finished; {progress}", rows)
        next_step(["status", folder.display_name])
        return
    print_rows("Dataset finished", rows)
    next_step(*_next_steps(folder, statistics))


def _next_steps(folder: DatasetFolder, statistics: Statistics) -> Iterator[Sequence[str]]:
    """Yield the next commands for a finished dataset; training only where it has such scenes."""
    yield ("verify", folder.display_name)
    yield ("inspect", folder.display_name)
    if statistics.scenes_by_split.get("train") and _fits_training(read_head(folder.manifest)):
        yield ("train", _RUN, "--data", folder.display_name)


def _fits_training(manifest: Manifest) -> bool:
    """Return whether the smallest training preset fits the pictures, and torch is installed."""
    from train.runs import named_run  # late, so that the first line is printed sooner

    run = named_run(_RUN)
    pictures = manifest.settings["renders"]["resolution"]
    has_views = manifest.num_views >= run.views_per_scene
    return has_views and pictures % run.resolution == 0 and find_spec("torch") is not None


def _print_json(
    folder: DatasetFolder,
    outcome: "Outcome",
    rejected: Sequence[tuple[str, str, int]],
    seconds: float,
) -> None:
    statistics = outcome.statistics
    row: dict[str, object] = {
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
    }
    if statistics:
        row["scenes"] = statistics.num_scenes
        row["views"] = statistics.num_views
        row["bytes"] = statistics.num_bytes
    print_json(row)


def _shown_path(folder: DatasetFolder, path: Path) -> str:
    """Return the path or URL of a file of a dataset, for people."""
    return f"{folder.display_name}/{path.relative_to(folder.root)}"


def _print_notes(notes: Sequence[str]) -> None:
    for text in notes[:_MAX_NOTES]:
        note(text)
    if len(notes) > _MAX_NOTES:
        note(f"{len(notes) - _MAX_NOTES} more; --json has all")


def _licences(folder: DatasetFolder) -> str:
    counts = Counter(entry.licence for entry in read_objects_lock(folder.objects_lock))
    text = ", ".join(f"{name} ({count})" for name, count in counts.most_common())
    return text.replace(USER_PROVIDED, f"{USER_PROVIDED}, taken as yours to use")
