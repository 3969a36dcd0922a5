"""`trilight convert`: a scene, a sample or a whole shard in another form."""

from pathlib import Path
from typing import Annotated

from infra.cli.console import first_words, note, print_json, print_rows, progress_bars
from infra.cli.options import Shown, command
from pipeline.exchange.from_description import AlbedoOverOne
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class Conversion:
    """The scene to convert, and the file to write."""

    source: str
    """Scene .usda .usdc .usdz .usd .glb .gltf, RenderFormer .json or .h5, .safetensors, a shard
    .tar, or one sample SHARD.tar::KEY."""
    target: Path
    """File .usda .usdc .usdz .glb .json .h5 or .safetensors."""
    budget: Annotated[int | None, Within(1, 2**31 - 1, unit="triangles")] = None
    """Maximum number of triangles of each scene, reached by simplifying what is not an emitter; by
    default nothing is simplified."""
    usd_folder: Path | None = None
    """Folder below which a USD stage may read files; by default the folder of the stage."""
    albedo_over_one: AlbedoOverOne = "scale"
    """How to treat a material of a RenderFormer scene whose diffuse and specular albedos add up to
    more than 1: scale multiplies both by one factor, refuse leaves the scene out."""


@command("source", "target")
def convert(asked: Conversion, shown: Shown) -> None:
    first_words(f"Converting {asked.source} to {asked.target}", silent=shown.json)
    from pipeline.exchange.convert import convert_scene
    from pipeline.exchange.open_scene import scene_source

    wanted = scene_source(
        asked.source,
        many=True,
        usd_folder=asked.usd_folder,
        albedo_over_one=asked.albedo_over_one,
    )
    with progress_bars() as bars:
        task = bars.add_task("files", total=None, note="", visible=not shown.json)
        found = convert_scene(
            wanted,
            asked.target,
            budget=asked.budget,
            done=lambda now, total: bars.update(task, completed=now, total=total),
        )
    if shown.json:
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
    more = len(found.files) - 1
    written = f"{found.files[0]}" + (
        f" and {more} {'files' if more > 1 else 'file'} more" if more else ""
    )
    print_rows("Converted", [("written", written), ("triangles", f"{found.triangles}")])
