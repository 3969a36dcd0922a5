"""`trilight shards`: new datasets made of finished ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App

from infra.cli.console import (
    first_words,
    next_step,
    note,
    print_json,
    print_rows,
    print_table,
    progress_bars,
)
from infra.cli.options import Shown, command
from pipeline.shards.derive import Derive
from pipeline.shards.finished import open_finished
from pipeline.shards.listing import listed_scenes
from pipeline.shards.plans import Selection
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Within

app = App(name="shards", help_epilogue="")

_MOST_LISTED = 40
"""Most scenes that a person is shown."""


@checked()
class NewDataset:
    """The new dataset."""

    out: Path
    """Folder of the new dataset, which must not exist."""


@checked()
class Datasets:
    """The source datasets."""

    datasets: tuple[Path, ...]
    """Folders of finished datasets."""


@checked()
class Selected:
    """The dataset, and the scenes to keep."""

    dataset: Path
    """Folder of a finished dataset."""
    split: Literal["train", "validation", "test"] | None = None
    """Keep only the scenes of this split; by default all."""
    template: str | None = None
    """Keep only the scenes of this layout, such as plane; by default all."""
    min_noise_floor_db: Annotated[float | None, Within(-100, 200, unit="dB")] = None
    """Keep only the scenes whose views all have at least this noise floor (psnr_log_db); by default
    all."""
    where: str | None = None
    """Keep only the scenes for which this condition holds, such as "max(roughness) < 0.3 and
    lights_per_scene > 1" (the reference page Quantities has the names); by default all."""

    @property
    def selection(self) -> Selection:
        """What is to be kept."""
        return Selection(
            split=self.split,
            template=self.template,
            min_noise_floor_db=self.min_noise_floor_db,
            where=self.where,
        )


@checked()
class Resharded:
    """The dataset, and the size of its new shards."""

    dataset: Path
    """Folder of a finished dataset."""
    scenes_per_shard: Annotated[int, Within(1, 10**9, unit="scenes")]
    """Number of scenes in each new shard."""


@app.command(
    help="Put datasets together, shard by shard; later ones get keys beyond those of earlier ones."
)
@command("datasets")
def merge(sources: Datasets, new: NewDataset, shown: Shown) -> None:
    if len(sources.datasets) < 2:
        raise TrilightError(f"merge: {len(sources.datasets)} dataset; expected at least 2.")
    _run(sources.datasets, Derive(operation="merge"), new.out, as_json=shown.json)


@app.command(help="Keep the scenes that meet every condition, under their keys.")
@command("dataset")
def select(chosen: Selected, new: NewDataset, shown: Shown) -> None:
    if chosen.selection == Selection():
        raise TrilightError("select: expected --where, --split, --template or --min-noise-floor.")
    derive = Derive(operation="select", selection=chosen.selection)
    _run([chosen.dataset], derive, new.out, as_json=shown.json)


@app.command(
    name="list", help="List the scenes that `select` would keep, by default all; nothing is made."
)
@command("dataset")
def list_scenes(chosen: Selected, shown: Shown) -> None:
    first_words(f"Reading {chosen.dataset}", silent=shown.json)
    with progress_bars() as bars:
        task = bars.add_task("shards", total=None, note="", visible=not shown.json)
        scenes = listed_scenes(
            open_finished(str(chosen.dataset)),
            chosen.selection,
            progress=lambda done, total: bars.update(task, completed=done, total=total),
        )
    if shown.json:
        print_json({"of": scenes.of, "scenes": list(scenes.rows)})
        return
    title = f"{len(scenes.rows)} of {scenes.of} scenes; of several views the least, most spp"
    print_table(title, scenes.rows[:_MOST_LISTED])
    if len(scenes.rows) > _MOST_LISTED:
        note(f"the first {_MOST_LISTED} are shown; --json lists all")
    if scenes.rows:
        words = ["shards", "select", str(chosen.dataset), "--out", f"{chosen.dataset}-selected"]
        options = {
            "--split": chosen.split,
            "--template": chosen.template,
            "--min-noise-floor": chosen.min_noise_floor_db,
            "--where": chosen.where,
        }
        given = [(name, str(value)) for name, value in options.items() if value is not None]
        next_step([*words, *(word for pair in given for word in pair)])


@app.command(help="Divide the scenes of every split into shards of another size, under their keys.")
@command("dataset")
def reshard(asked: Resharded, new: NewDataset, shown: Shown) -> None:
    derive = Derive(operation="reshard", scenes_per_shard=asked.scenes_per_shard)
    _run([asked.dataset], derive, new.out, as_json=shown.json)


def _run(datasets: Sequence[Path], derive: Derive, out: Path, *, as_json: bool) -> None:
    first_words(f"Making {out}", silent=as_json)
    from pipeline.making.derive_dataset import derive_dataset  # slow: matplotlib

    places = [str(path) for path in datasets]
    with progress_bars() as bars:
        task = bars.add_task("shards", total=None, note="", visible=not as_json)
        digest, statistics = derive_dataset(
            places,
            derive,
            out,
            progress=lambda done, total: bars.update(task, completed=done, total=total),
        )
    if as_json:
        print_json(
            {
                "bytes": statistics.num_bytes,
                "dataset_digest": digest,
                "out": str(out),
                "scenes": statistics.num_scenes,
                "scenes_by_split": statistics.scenes_by_split,
                "views": statistics.num_views,
            }
        )
        return
    print_rows("Dataset finished", [*statistics.lines(), ("dataset digest", digest)])
    next_step(["verify", str(out)])
