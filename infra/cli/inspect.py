"""`trilight inspect`: what is in a dataset or in one scene, for a person."""

import os
import shlex
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from infra.cli.console import (
    first_words,
    look_at,
    note,
    print_json,
    print_rows,
    progress_bars,
)
from storage.dataset import Dataset, open_dataset
from storage.dataset_files import RemoteDatasetFiles
from storage.errors import TrilightError
from storage.failures import count_by_reason
from storage.layout import DatasetFolder
from storage.safe_url import safe_url
from storage.statistics import Statistics, dataset_statistics

if TYPE_CHECKING:
    from pipeline.documents.distributions import Distributions


_READ_ONLY = "It cannot be written there: choose a folder for report and sheet with --out."


def inspect(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SRC",
            help="a dataset (folder or URL), or one scene in any form that render reads",
        ),
    ],
    scenes: Annotated[int, typer.Option(help="scenes on the contact sheet")] = 16,
    by_template: Annotated[
        int | None, typer.Option(help="write templates.png too: so many scenes of each layout")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="write the report and the sheet here [the dataset]")
    ] = None,
    turntable: Annotated[
        Path | None, typer.Option(help="of one scene: write views from all sides here, X.png")
    ] = None,
    json: Annotated[bool, typer.Option(help="print the summary as JSON")] = False,
) -> None:
    """Write report, gallery and contact sheet anew, and print what the dataset holds.

    A dataset that is read-only, or on a server, is only summed up, unless there is an --out. Of one
    scene the summary is printed, with what of its file could not be carried over.
    """
    if not ("://" in source or Path(source).is_dir()):
        _inspect_scene(source, turntable, json=json)
        return
    if turntable is not None:
        raise TrilightError(f"--turntable: {source} is a dataset; expected one scene.")
    first_words(f"Reading {safe_url(source)}", silent=json)
    opened = open_dataset(source)
    _require_shards(opened)
    from pipeline.documents.distributions import dataset_distributions  # slow: matplotlib

    with progress_bars() as bars:
        total = len(opened.manifest.shards)
        task = bars.add_task("shards", total=total, note="", visible=not json)
        statistics = dataset_statistics(opened)
        found = dataset_distributions(opened, shard_done=lambda _: bars.advance(task))
    folder = _folder_of_documents(opened, out)
    if folder is not None:
        _write(opened, statistics, found, folder, max_scenes=scenes)
        if by_template is not None:
            _write_templates(opened, folder, per_template=by_template)
    if json:
        print_json(_as_json(opened, statistics, found))
        return
    _print_summary(opened.shown, opened, statistics, found)
    look_at(f"Look at {folder.report} and {folder.contact_sheet}" if folder else _READ_ONLY)


def _require_shards(opened: Dataset) -> None:
    if not opened.manifest.shards:
        raise TrilightError(
            f"{opened.shown}: the dataset is empty, since none of its shards is finished; expected "
            f"at least one. See how it goes on: `trilight status {shlex.quote(opened.shown)}`."
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
    from pipeline.flows.inspect_scene import inspect_scene
    from pipeline.flows.scene_source import scene_source

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
    *,
    max_scenes: int,
) -> None:
    from pipeline.documents.contact_sheet import write_contact_sheet
    from pipeline.documents.report import write_report

    write_contact_sheet(opened, statistics, max_scenes=max_scenes, out=folder)
    write_report(opened, found, out=folder)


def _write_templates(opened: Dataset, folder: DatasetFolder, *, per_template: int) -> None:
    from pipeline.documents.template_sheet import write_template_sheet

    if per_template < 1:
        raise TrilightError(f"--by-template is {per_template}; expected at least 1.")
    write_template_sheet(opened, per_template=per_template, out=folder)


def _as_json(opened: Dataset, statistics: Statistics, found: "Distributions") -> dict[str, object]:
    return {
        "bytes": statistics.num_bytes,
        "dataset_digest": opened.digest,
        "distributions": found.as_json(),
        "licences": Counter(entry.licence for entry in found.objects),
        "noise_floor_db": [round(float(v), 2) for v in statistics.noise_floor_db],
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
