"""`trilight verify`: is a dataset what its manifest says?"""

from pathlib import Path
from typing import Annotated

import typer

from infra.cli.console import console, print_json, print_rows, progress_bars
from storage.manifest import read_manifest
from storage.verify import verify_dataset


def verify(
    dataset: Annotated[Path, typer.Argument(help="folder of the dataset")],
    fast: Annotated[bool, typer.Option(help="compare sizes only")] = False,
    json: Annotated[bool, typer.Option(help="print the result as JSON")] = False,
) -> None:
    """Check every hash, member and law of a dataset; exit 1 with a list of what is wrong."""
    num_shards = len(read_manifest(dataset / "manifest.json").shards)
    with progress_bars() as bars:
        task = bars.add_task("shards", total=num_shards, note="", visible=not json)
        found = verify_dataset(dataset, fast=fast, shard_done=lambda _: bars.advance(task))
    manifest = found.manifest
    if json:
        print_json(
            {
                "dataset_digest": manifest.dataset_digest,
                "problems": list(found.problems),
                "samples": found.num_samples,
                "scenes_planned": manifest.num_scenes,
                "shards": num_shards,
            }
        )
    else:
        rows = [
            ("dataset digest", manifest.dataset_digest),
            ("shards", f"{num_shards}, {manifest.num_bytes / 1e6:.1f} MB"),
            ("scenes", f"{found.num_samples} of {manifest.num_scenes} planned"),
            ("checked", "sizes" if fast else "hashes, members, laws, pictures, splits"),
            *(("wrong", problem) for problem in found.problems),
        ]
        print_rows("Verified" if not found.problems else "Not what the manifest says", rows)
        if found.problems:
            console.print(
                "\nNext: delete the shards that are named and run `trilight generate` again.",
                style="bold",
            )
    if found.problems:
        raise typer.Exit(1)
