"""`trilight inspect`: prints a summary of a dataset, a training run or a scene."""

import os
import shlex
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from infra.cli.console import (
    Bars,
    command_line,
    first_words,
    print_result,
    suggest_look,
)
from infra.cli.options import command
from infra.run_record import is_run, run_facts, tensorboard_command
from storage.aliases import PRESET_ALIASES, name_for_people
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import Statistics, dataset_statistics, described_shards
from storage.errors import TrilightError
from storage.records.objects import count_by_reason
from storage.remote.url import safe_url
from storage.settings.described import checked
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from pipeline.documents.distributions import Distributions


_READ_ONLY = "It cannot be written there: choose a folder for report and sheet with --out."
_STATED = ("noise_floor_db", "expected_error_db", "noise_floor_linear_db", "object_noise_floor_db")


@checked()
class InspectOptions:
    """Source and images."""

    source: str
    """Dataset (folder or URL), training run's folder, or one scene file."""
    scenes: Annotated[int, Within(1, 10_000, unit="scenes")] = 16
    """Number of scenes on the contact sheet."""
    by_template: Annotated[int | None, Within(1, 1000, unit="scenes")] = None
    """Scenes of each layout on a second sheet, templates.png; by default no such sheet."""
    out: Path | None = None
    """Folder for the report and the sheet; by default the dataset's own."""
    turntable: Path | None = None
    """Image file X.png for views of one scene from all sides; by default none."""


@command("source")
def inspect(options: InspectOptions) -> None:
    source = options.source
    if not ("://" in source or Path(source).is_dir()):
        _inspect_scene(source, options.turntable)
        return
    if options.turntable is not None:
        raise TrilightError(f"--turntable: {source} is a folder; expected one scene.")
    if is_run(Path(source)):
        _inspect_run(Path(source))
        return
    first_words(f"Reading {safe_url(source)}")
    opened = open_dataset(source)
    name = opened.display_name
    if not opened.manifest.shards:
        raise TrilightError(
            f"{name}: the dataset is empty, since none of its shards is finished; expected at "
            f"least one. See its progress with `trilight status {shlex.quote(name)}`."
        )
    from pipeline.documents.distributions import dataset_distributions  # slow: matplotlib

    with Bars() as bars:
        total = len(described_shards(opened))
        task = bars.add_task("shards", total=total, note="")
        statistics = dataset_statistics(opened)
        distributions = dataset_distributions(opened, shard_done=lambda _: bars.advance(task))
    folder = DatasetFolder(options.out) if options.out else opened.local
    if folder and not options.out and not os.access(folder.root, os.W_OK | os.X_OK):
        folder = None
    if folder is not None:
        from pipeline.documents.checksums import renew_sums
        from pipeline.documents.report import write_report
        from pipeline.documents.sheets import write_contact_sheet, write_template_sheet

        write_contact_sheet(opened, statistics, max_scenes=options.scenes, out=folder)
        write_report(opened, distributions, out=folder)
        if options.by_template is not None:
            write_template_sheet(opened, per_template=options.by_template, out=folder)
        renew_sums(folder.root)
    _print_summary(name, opened, statistics, distributions)
    suggest_look(f"Look at {folder.report} and {folder.contact_sheet}" if folder else _READ_ONLY)


def _inspect_run(root: Path) -> None:
    """Print the progress of a training run."""
    facts = run_facts(root)
    print_result(str(root), _fact_rows(facts), facts)
    suggest_look(f"Curves and pictures: {tensorboard_command(root)}")
    if not facts["finished"]:
        preset = name_for_people(facts["run"], PRESET_ALIASES)
        words = ("train", preset, "--like", str(root), "--out", str(root), "--resume")
        suggest_look(f"To resume: {command_line(words)}, with the same --data as before.")


def _fact_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    def to_text(value: Any) -> str:
        if isinstance(value, bool):
            return "yes" if value else "no"
        return f"{value:.4g}" if isinstance(value, float) and abs(value) < 1e4 else str(value)

    return [(name.replace("_", " "), to_text(value)) for name, value in facts.items()]


def _inspect_scene(source: str, turntable: Path | None) -> None:
    first_words(f"Reading {source}")
    from pipeline.exchange.reader import scene_source
    from pipeline.generation.inspect_scene import inspect_scene

    facts, notes = inspect_scene(scene_source(source), turntable)
    print_result(source, _fact_rows(facts), {**facts, "notes": notes}, notes=notes)
    if turntable is not None:
        suggest_look(f"Look at {turntable}")


def _print_summary(
    title: str, opened: Dataset, statistics: Statistics, distributions: "Distributions"
) -> None:
    licences = Counter(entry.licence for entry in distributions.objects)
    splits = Counter(entry.split for entry in distributions.objects)
    rejected = count_by_reason(distributions.failures)
    record = {
        "bytes": statistics.num_bytes,
        "dataset_digest": opened.digest,
        "distributions": distributions.as_json(),
        "licences": licences,
        **_round_all({name: getattr(statistics, name) for name in _STATED}),
        "part_noise_floor_db": _round_all(statistics.part_noise_floor_db),
        "objects_by_split": splits,
        "rejections": [list(row) for row in rejected],
        "scenes_by_split": statistics.scenes_by_split,
        "scenes_by_template": statistics.scenes_by_template,
        "spp": [int(v) for v in statistics.spp],
    }
    rows = [
        ("build", opened.manifest.build),
        *statistics.lines(),
        ("objects", ", ".join(f"{count} {split}" for split, count in sorted(splits.items()))),
        ("licenses", ", ".join(f"{count} {name}" for name, count in sorted(licences.items()))),
        *(("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in rejected),
        ("dataset digest", opened.digest),
    ]
    print_result(title, rows, record)


def _round_all(
    errors_db: Mapping[str, NDArray[np.float64] | None],
) -> dict[str, list[float]]:
    """Return errors in dB as JSON values; those that are not stated are left out."""
    return {
        name: [round(float(value), 2) for value in values]
        for name, values in errors_db.items()
        if values is not None
    }
