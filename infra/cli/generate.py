"""`trilight generate`: objects, or scenes in files, to shards."""

import time
from pathlib import Path
from typing import Annotated

import typer

from infra.cli.changes import parse_changes
from infra.cli.completion import builds
from infra.cli.console import first_words, note
from infra.cli.generate_progress import watched
from infra.cli.generate_report import report
from pipeline.flows.builds import typed_build
from pipeline.flows.executors import find_executor
from pipeline.flows.order import DatasetOrder
from pipeline.renders.variant import choose_variant
from pipeline.scenes.described_albedos import require_choice
from storage.extensions import function_name
from storage.output import dataset_folder


def generate(
    build: Annotated[
        str,
        typer.Argument(
            help="named settings, such as smoke, or your own FILE.py:FUNCTION",
            autocompletion=builds,
        ),
    ],
    objects: Annotated[
        str | None,
        typer.Option(help="folder of 3D objects, its URL, builtin: or objaverse: [builtin:]"),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            help="folder of the dataset, or a bucket such as s3://bucket/folder [data/BUILD]"
        ),
    ] = None,
    scenes: Annotated[
        int | None, typer.Option(help="scenes, rounded up to whole shards [as the build says]")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="seed of every draw")] = None,
    resolution: Annotated[int | None, typer.Option(help="picture width in pixels")] = None,
    noise_floor: Annotated[
        float | None, typer.Option("--noise-floor", help="target in dB (psnr_log_db)")
    ] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="allow this licence too; may be repeated")
    ] = None,
    licence: Annotated[
        str | None, typer.Option(help="licence of files that state none [yours to use]")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="render processes that share the cores [1, or 1 for each graphics card]"),
    ] = None,
    shards: Annotated[
        str | None,
        typer.Option(
            help="make only shards A up to but not B, given as A:B; who makes the last finishes; "
            "machines that share a bucket should make different ones"
        ),
    ] = None,
    runner: Annotated[str, typer.Option(help="threads, of this process; or dask")] = "threads",
    address: Annotated[
        str | None, typer.Option(help="with --runner dask: scheduler, such as tcp://host:8786")
    ] = None,
    failure_budget: Annotated[
        float, typer.Option(help="share of scenes that may be given up")
    ] = 0.1,
    accept_environment: Annotated[
        bool, typer.Option(help="go on with a dataset begun with other library versions")
    ] = False,
    scenes_from: Annotated[
        Path | None,
        typer.Option(
            help="render every *.json of this folder (RenderFormer scenes) instead; the build's "
            "limits on scenes do not apply"
        ),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(help="with --scenes-from: first cameras of each file [all that every has]"),
    ] = None,
    albedo_over_one: Annotated[
        str, typer.Option(help="RenderFormer scenes with diffuse + specular above 1: scale, refuse")
    ] = "scale",
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="any other setting by its name in manifest.json, with its value in JSON, such as "
            "scenes.lights.coloured_share=0.5; may be repeated",
        ),
    ] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Turn objects into a verified, resumable dataset; run it again to go on after any stop."""
    order = DatasetOrder(
        build=typed_build(build),
        objects=objects,
        out=out or f"data/{function_name(build)}",
        scenes=scenes,
        seed=seed,
        resolution=resolution,
        noise_floor_db=noise_floor,
        allow_licences=tuple(allow_licence or ()),
        licence=licence,
        workers=workers,
        failure_budget=failure_budget,
        accept_environment=accept_environment,
        scenes_from=None if scenes_from is None else str(scenes_from),
        views=views,
        albedo_over_one=require_choice(albedo_over_one),
        shards=shards,
        changes=parse_changes(set_ or ()),
    )
    folder, started = dataset_folder(order.out), time.monotonic()
    first_words(f"Making {folder.shown} with the build {build}", silent=json)
    executor = find_executor(runner, address, workers)
    if (text := choose_variant().note) and not json:
        note(f"{text}; see trilight doctor")
    with watched(folder, silent=json):
        outcome = executor.make(order, address)
    report(folder, outcome, time.monotonic() - started, as_json=json)
