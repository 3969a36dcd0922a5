"""`trilight convert`: a scene, a sample or a whole shard in another form."""

from pathlib import Path
from typing import Annotated

import typer

from infra.cli.console import first_words, note, print_json, print_rows, progress_bars
from storage.errors import TrilightError


def convert(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SRC",
            help="scene .usda .usdc .usdz .usd, RenderFormer .json or .h5, .safetensors, a shard "
            ".tar or one sample SHARD.tar::KEY",
        ),
    ],
    target: Annotated[
        Path, typer.Argument(metavar="DST", help=".usda .usdc .usdz .json .h5 or .safetensors")
    ],
    budget: Annotated[
        int | None, typer.Option(help="most triangles of each scene; emitters stay whole")
    ] = None,
    usd_folder: Annotated[
        Path | None, typer.Option(help="a USD stage may read files below it [its own folder]")
    ] = None,
    albedo_over_one: Annotated[
        str, typer.Option(help="RenderFormer scenes with diffuse + specular above 1: scale, refuse")
    ] = "scale",
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Convert by extension, and say what could not be carried over."""
    if budget is not None and budget < 1:
        raise TrilightError(f"--budget is {budget}; expected at least 1.")
    first_words(f"Converting {source} to {target}", silent=json)
    from pipeline.flows.convert_scene import convert_scene
    from pipeline.flows.scene_source import scene_source
    from pipeline.scenes.described_albedos import require_choice

    wanted = scene_source(
        source,
        many=True,
        usd_folder=usd_folder,
        albedo_over_one=require_choice(albedo_over_one),
    )
    with progress_bars() as bars:
        task = bars.add_task("files", total=None, note="", visible=not json)
        found = convert_scene(
            wanted,
            target,
            budget=budget,
            done=lambda now, total: bars.update(task, completed=now, total=total),
        )
    if json:
        print_json(
            {
                "files": [str(path) for path in found.files],
                "notes": list(found.notes),
                "triangles": found.triangles,
            }
        )
        return
    for text in found.notes:
        note(text)
    shown = str(found.files[0]) if len(found.files) == 1 else f"{len(found.files)} files"
    print_rows("Converted", [("written", shown), ("triangles", f"{found.triangles}")])
