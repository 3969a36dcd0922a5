"""`trilight plan`: what a dataset will take, from a few scenes that are measured here."""

import dataclasses
from typing import Annotated

import typer

from infra.cli.changes import parse_changes
from infra.cli.completion import builds
from infra.cli.console import (
    first_words,
    next_step,
    note,
    print_json,
    print_rows,
    progress_bars,
)
from infra.cli.extending import extend_words
from infra.cli.leaving import temporary_folder
from pipeline.flows.builds import typed_build
from pipeline.flows.order import DatasetOrder
from pipeline.flows.order_words import generate_words
from pipeline.flows.price import USD_PER_CORE_HOUR, CorePrice
from storage.extensions import function_name


def plan(
    build: Annotated[
        str, typer.Argument(help="named settings, such as pretrain-256", autocompletion=builds)
    ],
    scenes: Annotated[int | None, typer.Option(help="scenes of the dataset [the build's]")] = None,
    objects: Annotated[str | None, typer.Option(help="as for generate [builtin:]")] = None,
    samples: Annotated[int, typer.Option(min=4, help="scenes to measure")] = 12,
    cores: Annotated[int, typer.Option(min=1, help="cores of the fleet, all of them")] = 64,
    price: Annotated[float, typer.Option(help="USD per core-hour")] = USD_PER_CORE_HOUR,
    resolution: Annotated[int | None, typer.Option(help="picture width in pixels")] = None,
    noise_floor: Annotated[
        float | None, typer.Option("--noise-floor", help="target in dB (psnr_log_db)")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="seed of every draw")] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="allow this licence too; may be repeated")
    ] = None,
    licence: Annotated[
        str | None, typer.Option(help="licence of files that state none [yours to use]")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="any other setting, as for generate")
    ] = None,
    json: Annotated[bool, typer.Option(help="print the result as JSON")] = False,
) -> None:
    """Measure a few scenes and predict time, cores, bytes and cost, each with an interval."""
    core_price = CorePrice(price=price)
    order = DatasetOrder(
        build=typed_build(build),
        objects=objects,
        scenes=scenes,
        seed=seed,
        resolution=resolution,
        noise_floor_db=noise_floor,
        allow_licences=tuple(allow_licence or ()),
        licence=licence,
        changes=parse_changes(set_ or ()),
    )
    first_words(f"Measuring {samples} scenes of {build}", silent=json)
    from infra.planning import measure_scenes, predict  # slow: every stage

    with progress_bars() as bars, temporary_folder("trilight-plan-") as place:
        task = bars.add_task("scenes", total=samples, note="", visible=not json)
        measured = measure_scenes(order, samples, place, lambda: bars.advance(task))
    found = predict(measured, order, cores=cores, usd_per_core_hour=core_price.price)
    if json:
        print_json(dataclasses.asdict(found))
        return
    print_rows(
        f"{build}, {found.num_scenes} scenes, predicted from {samples} (90 % intervals)",
        [
            ("core-hours", found.core_hours.shown("{:,.1f}")),
            (f"hours on {cores} cores", found.hours.shown("{:,.1f}")),
            ("USD", found.usd.shown("{:,.2f}")),
            ("GB", found.gigabytes.shown("{:,.2f}")),
            ("shards", f"{found.num_shards} of {found.scenes_per_shard} scenes"),
            ("a shard", found.shard_hours.shown("{:,.2f} core-hours")),
            ("Prefect's task runs", f"{found.num_tasks} of {found.task_minutes:.1f} minutes"),
            ("Prefect's database", f"{found.database_mb:.0f} MB"),
            ("manifest.json", f"{found.manifest_mb:.1f} MB"),
        ],
    )
    for text in found.notes:
        note(text)
    asked = ("generate", build, *generate_words(order)[2:], *extend_words())
    next_step((*asked, "--out", f"data/{function_name(build)}"))
