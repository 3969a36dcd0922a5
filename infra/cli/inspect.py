"""`trilight inspect`: what is in a dataset, for a person."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from infra.cli.console import console, print_json, print_rows
from pipeline.documents.contact_sheet import write_contact_sheet
from storage.dataset import open_dataset
from storage.failures import count_by_reason, read_failures
from storage.objects_lock import read_objects_lock
from storage.statistics import dataset_statistics


def inspect(
    dataset: Annotated[Path, typer.Argument(help="folder of the dataset")],
    scenes: Annotated[int, typer.Option(help="scenes on the contact sheet")] = 16,
    json: Annotated[bool, typer.Option(help="print the summary as JSON")] = False,
) -> None:
    """Write the contact sheet anew and print what the dataset holds."""
    opened = open_dataset(str(dataset))
    statistics = dataset_statistics(opened)
    write_contact_sheet(opened, statistics, max_scenes=scenes)
    objects = read_objects_lock(opened.folder.objects_lock)
    licences = Counter(entry.licence for entry in objects)
    splits = Counter(entry.split for entry in objects)
    rejected = count_by_reason(read_failures(opened.folder.failures))
    if json:
        print_json(
            {
                "bytes": statistics.num_bytes,
                "dataset_digest": opened.digest,
                "licences": licences,
                "noise_floor_db": [round(float(v), 2) for v in statistics.noise_floor_db],
                "objects_by_split": splits,
                "rejections": [list(row) for row in rejected],
                "scenes_by_split": statistics.scenes_by_split,
                "scenes_by_template": statistics.scenes_by_template,
                "spp": [int(v) for v in statistics.spp],
            }
        )
        return
    rows = [
        ("build", opened.manifest.build),
        *statistics.lines(),
        ("objects", ", ".join(f"{count} {split}" for split, count in sorted(splits.items()))),
        ("licences", ", ".join(f"{count} {name}" for name, count in sorted(licences.items()))),
        *(("rejected", f"{count} x {stage}: {reason}") for stage, reason, count in rejected),
        ("dataset digest", opened.digest),
    ]
    print_rows(str(dataset), rows)
    console.print(f"\nLook at {opened.folder.contact_sheet}", style="bold")
