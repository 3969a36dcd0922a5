"""`trilight export`: a dataset as files that another library opens."""

from pathlib import Path
from typing import Literal

from infra.cli.console import first_words, note, print_json, print_rows, progress_bars
from infra.cli.options import Shown, command
from pipeline.exchange.exports.export import ExportForm
from storage.remote.safe_url import safe_url
from storage.settings.described import checked


@checked()
class ExportAsked:
    """The dataset, and the form to write."""

    source: str
    """A dataset (folder or URL)."""
    form: ExportForm
    """nerfstudio: transforms.json with pictures and depth; coco: masks and boxes of objects;
    huggingface: a folder that datasets.load_dataset reads, with pictures, depth and ids; hypersim:
    HDF5 of reflectance, illumination, residual and geometry (with renders.split_lobes=true); h5,
    json, usd, exr: each scene as RenderFormer's HDF5, as its JSON with meshes or as USD, and the
    pictures as OpenEXR; benchmark: these four, each in its folder, with a table of views."""
    out: Path
    """Folder to write, which must be empty or not exist."""
    split: Literal["train", "validation", "test"] | None = None
    """Write only the scenes of this split; by default all."""
    scene: str | None = None
    """Key of the only scene; by default all."""


@command("source")
def export(asked: ExportAsked, shown: Shown) -> None:
    first_words(f"Exporting {safe_url(asked.source)} to {asked.out}", silent=shown.json)
    from pipeline.exchange.exports.export import export_dataset  # slow: Pillow

    scenes = views = 0
    with progress_bars() as bars:
        task = bars.add_task("scenes", total=None, note="", visible=not shown.json)

        def written(num_views: int) -> None:
            nonlocal scenes, views
            scenes = scenes + 1
            views = views + num_views
            bars.advance(task)

        notes = export_dataset(
            asked.source,
            asked.form,
            asked.out,
            split=asked.split,
            scene=asked.scene,
            done=lambda sample: written(sample.scene.num_views),
        )
    if shown.json:
        about = {"form": asked.form, "out": str(asked.out), "scenes": scenes, "views": views}
        print_json({**about, "notes": list(notes)})
        return
    for text in notes:
        note(text)
    print_rows(
        "Exported",
        [
            ("form", asked.form),
            ("out", str(asked.out)),
            ("written", f"{scenes} scenes, {views} views"),
        ],
    )
