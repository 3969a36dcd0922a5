"""`trilight inspect`: what is in a dataset, in a run or in one scene, for a person."""

import os
import shlex
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from infra.cli.console import (
    first_words,
    look_at,
    note,
    print_json,
    print_rows,
    progress_bars,
)
from infra.cli.options import Shown, command
from infra.run_record import is_run, run_facts, tensorboard_command
from storage.dataset.dataset import Dataset, RemoteDatasetFiles, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.sampled import described_shards
from storage.dataset.statistics import Statistics, dataset_statistics
from storage.errors import TrilightError
from storage.records.objects import count_by_reason
from storage.remote.safe_url import safe_url
from storage.settings.described import checked
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from pipeline.documents.distributions import Distributions


_READ_ONLY = "It cannot be written there: choose a folder for report and sheet with --out."


@checked()
class Inspected:
    """The dataset, run or scene, and the pictures to write."""

    source: str
    """A dataset (folder or URL), the folder of a training run, or one scene in any form that render
    reads."""
    scenes: Annotated[int, Within(1, 10_000, unit="scenes")] = 16
    """Number of scenes on the contact sheet."""
    by_template: Annotated[int | None, Within(1, 1000, unit="scenes")] = None
    """Number of scenes of each layout on a second sheet, templates.png; by default it is not
    written."""
    out: Path | None = None
    """Folder for the report and the sheet; by default the dataset's own."""
    turntable: Path | None = None
    """For one scene: picture X.png to write, with views from all sides; by default none is written.
    """


@command("source")
def inspect(asked: Inspected, shown: Shown) -> None:
    source = asked.source
    if not ("://" in source or Path(source).is_dir()):
        _inspect_scene(source, asked.turntable, json=shown.json)
        return
    if asked.turntable is not None:
        raise TrilightError(f"--turntable: {source} is a folder; expected one scene.")
    if is_run(Path(source)):
        _inspect_run(Path(source), json=shown.json)
        return
    first_words(f"Reading {safe_url(source)}", silent=shown.json)
    opened = open_dataset(source)
    _require_shards(opened)
    from pipeline.documents.distributions import dataset_distributions  # slow: matplotlib

    with progress_bars() as bars:
        total = len(described_shards(opened))
        task = bars.add_task("shards", total=total, note="", visible=not shown.json)
        statistics = dataset_statistics(opened)
        found = dataset_distributions(opened, shard_done=lambda _: bars.advance(task))
    folder = _folder_of_documents(opened, asked.out)
    if folder is not None:
        _write(opened, statistics, found, folder, asked)
    if shown.json:
        print_json(_as_json(opened, statistics, found))
        return
    _print_summary(opened.shown, opened, statistics, found)
    look_at(f"Look at {folder.report} and {folder.contact_sheet}" if folder else _READ_ONLY)


def _inspect_run(root: Path, *, json: bool) -> None:
    """Say how far a run is."""
    facts = run_facts(root)
    if json:
        print_json(facts)
        return
    print_rows(str(root), [(name.replace("_", " "), str(value)) for name, value in facts.items()])
    look_at(f"Curves and pictures: {tensorboard_command(root)}")


def _require_shards(opened: Dataset) -> None:
    if not opened.manifest.shards:
        raise TrilightError(
            f"{opened.shown}: the dataset is empty, since none of its shards is finished; expected "
            f"at least one. See its progress with `trilight status {shlex.quote(opened.shown)}`."
        )


def _folder_of_documents(opened: Dataset, out: Path | None) -> DatasetFolder | None:
    """Return where report and sheet go; None where nobody said and it cannot be there."""
    if out is not None:
        return DatasetFolder(out)
    if isinstance(opened.files, RemoteDatasetFiles) or not os.access(
        opened.folder.root, os.W_OK | os.X_OK
    ):
        return None
    return opened.folder


def _inspect_scene(source: str, turntable: Path | None, *, json: bool) -> None:
    first_words(f"Reading {source}", silent=json)
    from pipeline.exchange.open_scene import scene_source
    from pipeline.making.inspect_scene import inspect_scene

    found = inspect_scene(scene_source(source), turntable)
    if json:
        print_json({**found.facts, "notes": list(found.notes)})
        return
    for text in found.notes:
        note(text)
    print_rows(
        source, [(name.replace("_", " "), str(value)) for name, value in found.facts.items()]
    )
    if turntable is not None:
        look_at(f"Look at {turntable}")


def _write(
    opened: Dataset,
    statistics: Statistics,
    found: "Distributions",
    folder: DatasetFolder,
    asked: Inspected,
) -> None:
    from pipeline.documents.report import write_report
    from pipeline.documents.sheets import write_contact_sheet, write_template_sheet
    from pipeline.documents.sums import renew_sums

    write_contact_sheet(opened, statistics, max_scenes=asked.scenes, out=folder)
    write_report(opened, found, out=folder)
    if asked.by_template is not None:
        write_template_sheet(opened, per_template=asked.by_template, out=folder)
    renew_sums(folder.root)


def _as_json(opened: Dataset, statistics: Statistics, found: "Distributions") -> dict[str, object]:
    return {
        "bytes": statistics.num_bytes,
        "dataset_digest": opened.digest,
        "distributions": found.as_json(),
        "licences": Counter(entry.licence for entry in found.objects),
        "noise_floor_db": _rounded(statistics.noise_floor_db),
        "noise_floor_linear_db": _rounded(statistics.noise_floor_linear_db),
        "object_noise_floor_db": _rounded(statistics.object_noise_floor_db),
        "part_noise_floor_db": {
            part: _rounded(floors_db) for part, floors_db in statistics.part_noise_floor_db.items()
        },
        "objects_by_split": Counter(entry.split for entry in found.objects),
        "rejections": [list(row) for row in count_by_reason(found.failures)],
        "scenes_by_split": statistics.scenes_by_split,
        "scenes_by_template": statistics.scenes_by_template,
        "spp": [int(v) for v in statistics.spp],
    }


def _print_summary(
    title: str, opened: Dataset, statistics: Statistics, found: "Distributions"
) -> None:
    licences = Counter(entry.licence for entry in found.objects)
    splits = Counter(entry.split for entry in found.objects)
    rejected = count_by_reason(found.failures)
    rows = [
        ("build", opened.manifest.build),
        *statistics.lines(),
        ("objects", ", ".join(f"{count} {split}" for split, count in sorted(splits.items()))),
        ("licences", ", ".join(f"{count} {name}" for name, count in sorted(licences.items()))),
        *(("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in rejected),
        ("dataset digest", opened.digest),
    ]
    print_rows(title, rows)


def _rounded(floors_db: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 2) for value in floors_db]
