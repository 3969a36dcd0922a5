"""`trilight shards`: new datasets made of finished ones."""

from pathlib import Path
from typing import Annotated

import typer

from infra.cli.console import first_words, next_step, print_json, print_rows, progress_bars
from pipeline.shards.derive import Derive
from pipeline.shards.plans import Selection
from storage.errors import TrilightError

app = typer.Typer(
    add_completion=False, no_args_is_help=True, help="Make new datasets of finished ones."
)

Source = Annotated[Path, typer.Argument(help="folder of a finished dataset")]
Out = Annotated[Path, typer.Option(help="folder of the new dataset; must not exist")]
Json = Annotated[bool, typer.Option(help="print the outcome as JSON")]


@app.command("merge")
def merge(
    datasets: Annotated[list[Path], typer.Argument(help="folders of finished datasets")],
    out: Out,
    json: Json = False,
) -> None:
    """Put datasets together, shard by shard; later ones get keys beyond those of earlier ones."""
    if len(datasets) < 2:
        raise TrilightError(f"merge: {len(datasets)} dataset; expected at least 2.")
    _run(datasets, Derive(operation="merge"), out, as_json=json)


@app.command("select")
def select(
    dataset: Source,
    out: Out,
    split: Annotated[str | None, typer.Option(help="train, validation or test")] = None,
    template: Annotated[str | None, typer.Option(help="layout, such as plane")] = None,
    min_noise_floor: Annotated[
        float | None, typer.Option(help="least noise floor of every view of a scene, dB")
    ] = None,
    json: Json = False,
) -> None:
    """Keep the scenes that meet every condition, under their keys."""
    selection = Selection(split=split, template=template, min_noise_floor_db=min_noise_floor)
    if selection == Selection():
        raise TrilightError("select: expected --split, --template or --min-noise-floor.")
    _run([dataset], Derive(operation="select", selection=selection), out, as_json=json)


@app.command("reshard")
def reshard(
    dataset: Source,
    out: Out,
    scenes_per_shard: Annotated[int, typer.Option(help="scenes of each new shard")],
    json: Json = False,
) -> None:
    """Divide the scenes of every split into shards of another size, under their keys."""
    derive = Derive(operation="reshard", scenes_per_shard=scenes_per_shard)
    _run([dataset], derive, out, as_json=json)


def _run(datasets: list[Path], derive: Derive, out: Path, *, as_json: bool) -> None:
    first_words(f"Making {out}", silent=as_json)
    from pipeline.flows.derive_dataset import derive_dataset  # slow: matplotlib

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
