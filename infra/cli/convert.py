"""`trilight convert`: writes a scene, a sample or a shard in another format."""

from pathlib import Path
from typing import Annotated

from infra.cli.console import first_words, print_result, progress
from infra.cli.options import command
from pipeline.exchange.from_description import AlbedoOverOne
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class ConvertOptions:
    """Source and target."""

    source: str
    """Scene .usda .usdc .usdz .usd .glb .gltf .json .h5 .safetensors, SHARD.tar, or
    SHARD.tar::KEY."""
    target: Path
    """File .usda .usdc .usdz .glb .json .h5 or .safetensors."""
    budget: Annotated[int | None, Within(1, 2**31 - 1, unit="triangles")] = None
    """Maximum number of triangles of each scene; emitters are not simplified; by default none."""
    usd_folder: Path | None = None
    """Folder below which a USD stage may read files; by default its own folder."""
    albedo_over_one: AlbedoOverOne = "scale"
    """Scale or refuse RenderFormer materials whose albedos sum to above 1."""


@command("source", "target")
def convert(options: ConvertOptions) -> None:
    first_words(f"Converting {options.source} to {options.target}")
    from pipeline.exchange.convert import convert_scene
    from pipeline.exchange.open_scene import scene_source

    scene = scene_source(
        options.source,
        many=True,
        usd_folder=options.usd_folder,
        albedo_over_one=options.albedo_over_one,
    )
    with progress("files") as done:
        result = convert_scene(scene, options.target, budget=options.budget, done=done)
    files = [str(path) for path in result.files]
    record = {"files": files, "notes": list(result.notes), "triangles": result.triangles}
    more = len(files) - 1
    written = files[0] + (f" and {more} {'files' if more > 1 else 'file'} more" if more else "")
    rows = [("written", written), ("triangles", f"{result.triangles}")]
    print_result("Converted", rows, record, notes=result.notes)
