"""`trilight passes`: depth, normals, ids and more of stored scenes, as OpenEXR."""

from pathlib import Path
from typing import Annotated

from infra.cli.console import first_words, note, print_json, print_rows, progress_bars
from infra.cli.options import Shown, command
from storage.records.exr import MAX_RESOLUTION
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import MOST_A_SIDE
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class PassesAsked:
    """The scenes, and what to write of them."""

    source: str
    """A dataset (folder or URL), or a scene in any form that convert reads."""
    out: Path
    """Folder for the files SCENE.VIEW.passes.exr."""
    passes: tuple[str, ...] = ("depth", "normal", "object")
    """Passes, one or several with commas between them; the reference page Passes lists all."""
    scene: str | None = None
    """Key of the only scene; by default all."""
    view: Annotated[int | None, Within(0, 10_000)] = None
    """Number of the only view, from 0; by default all."""
    resolution: Annotated[int | None, Within(1, MAX_RESOLUTION, unit="pixels")] = None
    """Width and height of the pictures; by default those of the dataset's pictures, and 256 for the
    file of a scene."""
    rays_a_side: Annotated[int, Within(1, MOST_A_SIDE, unit="rays")] = 1
    """Rays along each side of a pixel, for passes that are averaged; what a dataset stores has one.
    """


@command("source")
def passes(asked: PassesAsked, shown: Shown) -> None:
    names = pass_names(name for words in asked.passes for name in words.split(","))
    first_words(f"Writing {', '.join(names)} to {asked.out}", silent=shown.json)
    from pipeline.exchange.pass_files import WantedPasses, write_passes

    wanted = WantedPasses(
        names=names,
        scene=asked.scene,
        view=asked.view,
        resolution=asked.resolution,
        rays_a_side=asked.rays_a_side,
    )
    files: list[Path] = []
    with progress_bars() as bars:
        task = bars.add_task("views", total=None, note="", visible=not shown.json)

        def written(path: Path) -> None:
            files.append(path)
            bars.advance(task)

        notes = write_passes(asked.source, asked.out, wanted, done=written)
    if shown.json:
        print_json({"files": [str(path) for path in files], "notes": list(notes), "passes": names})
        return
    for text in notes:
        note(text)
    print_rows("Passes", [("written", f"{len(files)} files"), ("passes", ", ".join(names))])
