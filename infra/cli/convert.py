"""`trilight convert`, `export` and `push`: scenes and datasets for other programs and people."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from infra.cli.console import (
    first_words,
    next_step,
    print_json,
    print_result,
    print_rows,
    progress,
    suggest_look,
)
from infra.cli.options import command
from pipeline.exchange.exports.export import ExportForm
from pipeline.exchange.from_description import AlbedoOverOne
from storage.remote.url import safe_url
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
    from pipeline.exchange.reader import scene_source

    scene = dataclasses.replace(
        scene_source(options.source, many=True),
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


@checked()
class ExportOptions:
    """Source and format."""

    source: str
    """Dataset, a folder or a URL."""
    form: ExportForm
    """Format of the files. nerfstudio: transforms.json, images and depth. coco: masks and boxes.
    huggingface: images, depth and ids for datasets.load_dataset. hypersim: HDF5 of reflectance,
    illumination, residual and geometry (needs renders.split_lobes=true). energon: the shards as
    they are, with NVIDIA Energon's metadata. h5, json, usd: each scene
    as RenderFormer's HDF5, as its JSON with meshes, or as USD. exr: images as OpenEXR. benchmark:
    the last four, each in its folder, with a table of views."""
    out: Path
    """Folder to write, which must be empty or not exist."""
    split: Literal["train", "validation", "test"] | None = None
    """Write only the scenes of this split; by default all."""
    scene: str | None = None
    """Key of the only scene to write; by default all."""


@command("source")
def export(options: ExportOptions) -> None:
    first_words(f"Exporting {safe_url(options.source)} to {options.out}")
    from pipeline.exchange.exports.export import export_dataset  # slow: Pillow

    views: list[int] = []
    """Number of views of each written scene."""
    notes = export_dataset(
        options.source,
        options.form,
        options.out,
        split=options.split,
        scene=options.scene,
        done=views.append,
    )
    about = {"form": options.form, "out": str(options.out)}
    record = {**about, "scenes": len(views), "views": sum(views), "notes": list(notes)}
    rows = [*about.items(), ("written", f"{len(views)} scenes, {sum(views)} views")]
    print_result("Exported", rows, record, notes=notes)


@checked()
class PushOptions:
    """Upload."""

    folder: Path
    """Finished dataset, folder with model.safetensors, or page with index.html."""
    repository: str
    """Repository USER/NAME, which is created if it is missing."""
    private: bool = False
    """Make a new repository private; refuse one that is public."""
    dry_run: bool = False
    """Check the folder and print the upload, but upload nothing."""


@command("folder", "repository")
def push(options: PushOptions) -> None:
    first_words(f"Looking through {options.folder}")
    from infra.release.push_to_hub import planned_upload
    from infra.release.push_to_hub import push as upload_all

    folder = options.folder
    repository = options.repository
    kind, files, num_bytes = planned_upload(folder, repository)
    facts: dict[str, str | int] = {
        "folder": str(folder),
        "repository": repository,
        "kind": kind,
        "files": files,
        "bytes": num_bytes,
    }
    if not options.dry_run:
        first_words(f"Uploading to {repository}")
        facts["address"] = upload_all(folder, repository, kind, private=options.private)
    print_json(facts)
    rows = [(name, str(value)) for name, value in facts.items() if name != "bytes"]
    title = "Would be uploaded" if options.dry_run else "Uploaded"
    print_rows(title, [*rows, ("size", f"{num_bytes / 1e6:.1f} MB")])
    if options.dry_run:
        private = ["--private"] if options.private else []
        next_step(["push", str(folder), repository, *private])
    elif kind == "dataset":
        next_step(["verify", f"hf://datasets/{repository}"])
    else:
        suggest_look(f"Look at {facts['address']}")
