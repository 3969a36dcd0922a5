"""`trilight shards`: makes new datasets from finished ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App, Group

from infra.cli.commands import HELP_FLAGS
from infra.cli.console import (
    first_words,
    next_step,
    note,
    print_json,
    print_result,
    print_table,
    progress,
)
from infra.cli.options import command
from pipeline.generation.derive_dataset import DeriveOptions, Selection
from pipeline.generation.derive_dataset import list_scenes as read_scene_rows
from pipeline.shards.finished_dataset import open_finished
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.overrides import option_words
from storage.settings.ranges import Within

app = App(name="shards", help_epilogue="", help_flags=HELP_FLAGS, group_commands=Group("Commands"))

_MOST_LISTED = 40
"""Maximum number of scenes in a printed list."""


@checked()
class NewDatasetOptions:
    """New dataset."""

    out: Path
    """Folder of the new dataset, which must not exist."""


@checked()
class MergeOptions:
    """Sources."""

    datasets: tuple[Path, ...]
    """Folders of two or more finished datasets."""


@checked()
class SourceOptions:
    """Source."""

    dataset: Path
    """Folder of a finished dataset."""


@checked()
class ReshardOptions(SourceOptions):
    """Source and shard size."""

    scenes_per_shard: Annotated[int, Within(1, 10**9, unit="scenes")]
    """Number of scenes in each new shard."""


@app.command(help="Merge datasets shard by shard; later ones get new keys.")
@command("datasets")
def merge(sources: MergeOptions, new: NewDatasetOptions) -> None:
    if len(sources.datasets) < 2:
        raise TrilightError(f"merge: {len(sources.datasets)} dataset; expected at least 2.")
    _run(sources.datasets, DeriveOptions(operation="merge"), new.out)


@app.command(help="Keep the scenes that meet every condition, under their keys.")
@command("dataset")
def select(source: SourceOptions, selection: Selection, new: NewDatasetOptions) -> None:
    if selection == Selection():
        raise TrilightError("select: expected --where, --split, --template or --min-noise-floor.")
    _run([source.dataset], DeriveOptions(operation="select", selection=selection), new.out)


@app.command(
    name="list", help="List the scenes that `select` would keep, without making a dataset."
)
@command("dataset")
def list_scenes(source: SourceOptions, selection: Selection) -> None:
    place = str(source.dataset)
    first_words(f"Reading {place}")
    with progress("shards") as done:
        dataset = open_finished(place)
        rows = read_scene_rows(dataset, selection, progress=done)
    of = dataset.manifest.num_samples
    print_json({"of": of, "scenes": rows})
    print_table(
        f"{len(rows)} of {of} scenes; of several views the least, most spp", rows[:_MOST_LISTED]
    )
    if len(rows) > _MOST_LISTED:
        note(f"the first {_MOST_LISTED} are shown; --json lists all")
    if rows:
        words = ["shards", "select", place, "--out", f"{place}-selected"]
        next_step([*words, *option_words(selection)])


@app.command(help="Repack the scenes of every split into shards of another size.")
@command("dataset")
def reshard(options: ReshardOptions, new: NewDatasetOptions) -> None:
    derive = DeriveOptions(operation="reshard", scenes_per_shard=options.scenes_per_shard)
    _run([options.dataset], derive, new.out)


def _run(datasets: Sequence[Path], derive: DeriveOptions, out: Path) -> None:
    first_words(f"Making {out}")
    from pipeline.generation.derive_dataset import derive_dataset  # slow: matplotlib

    places = [str(path) for path in datasets]
    with progress("shards") as done:
        digest, statistics = derive_dataset(places, derive, out, progress=done)
    record = {
        "bytes": statistics.num_bytes,
        "dataset_digest": digest,
        "out": str(out),
        "scenes": statistics.num_scenes,
        "scenes_by_split": statistics.scenes_by_split,
        "views": statistics.num_views,
    }
    rows = [*statistics.lines(), ("dataset digest", digest)]
    print_result("Dataset finished", rows, record)
    next_step(["verify", str(out)])
