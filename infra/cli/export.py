"""`trilight export`: writes a dataset as files that another library opens."""

from pathlib import Path
from typing import Literal

from infra.cli.console import first_words, print_result, progress_bars
from infra.cli.options import command
from pipeline.exchange.exports.export import ExportForm
from storage.remote.safe_url import safe_url
from storage.settings.described import checked


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
    with progress_bars() as bars:
        task = bars.add_task("scenes", total=None, note="")

        def on_scene(num_views: int) -> None:
            views.append(num_views)
            bars.advance(task)

        notes = export_dataset(
            options.source,
            options.form,
            options.out,
            split=options.split,
            scene=options.scene,
            done=on_scene,
        )
    about = {"form": options.form, "out": str(options.out)}
    record = {**about, "scenes": len(views), "views": sum(views), "notes": list(notes)}
    rows = [*about.items(), ("written", f"{len(views)} scenes, {sum(views)} views")]
    print_result("Exported", rows, record, notes=notes)
