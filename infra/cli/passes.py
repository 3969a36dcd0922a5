"""`trilight passes`: writes depth, normals, ids and more of stored scenes as OpenEXR."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from infra.cli.console import first_words, print_result
from infra.cli.options import command
from pipeline.renders.mitsuba_variant import Device, activate, choose_gpu
from storage.raycast import FirstHitCaster, Surfaces
from storage.records.exr import MAX_RESOLUTION
from storage.records.passes import MOST_A_SIDE, pass_names
from storage.records.scene import Scene
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class PassOptions:
    """Scenes and passes."""

    source: str
    """Dataset (folder or URL), or a scene that convert reads."""
    out: Path
    """Folder for the files SCENE.VIEW.passes.exr."""
    passes: tuple[str, ...] = ("depth", "normal", "object")
    """Passes, separated by commas; the reference page Passes lists all."""
    scene: str | None = None
    """Key of the only scene; by default all."""
    view: Annotated[int | None, Within(0, 10_000)] = None
    """Number of the only view, from 0; by default all."""
    resolution: Annotated[int | None, Within(1, MAX_RESOLUTION, unit="pixels")] = None
    """Width of the images; by default the dataset's width, or 256 for a scene file."""
    rays_a_side: Annotated[int, Within(1, MOST_A_SIDE, unit="rays")] = 1
    """Rays along each pixel side, for averaged passes; stored ones have one."""
    device: Device | None = None
    """Device that traces: cpu, gpu, or auto (a GPU that renders a test scene correctly); by default
    auto. Files of cpu equal stored ones byte for byte; on a GPU a pixel on a rim may show the
    neighboring triangle."""


@command("source")
def passes(options: PassOptions) -> None:
    names = pass_names(name for words in options.passes for name in words.split(","))
    first_words(f"Writing {', '.join(names)} to {options.out}")
    from pipeline.exchange.exports.export import write_passes

    files: list[Path] = []
    notes: list[str] = []

    @functools.cache
    def caster() -> Callable[[Scene], FirstHitCaster]:
        gpu, note = choose_gpu("auto", device=options.device)
        notes.extend([f"{note}; see trilight doctor"] if note else [])
        if gpu is None:
            return Surfaces
        activate(gpu)
        from pipeline.renders.kernel_scene import CameraRays

        return CameraRays

    scene_notes = write_passes(
        options.source,
        options.out,
        names,
        scene=options.scene,
        view=options.view,
        resolution=options.resolution,
        rays_a_side=options.rays_a_side,
        done=files.append,
        caster=lambda scene: caster()(scene),  # probed once a source is there
    )
    notes = [*scene_notes, *notes]
    record = {"files": list(map(str, files)), "notes": notes, "passes": names}
    rows = [("files", str(len(files))), ("passes", ", ".join(names))]
    print_result("Passes", rows, record, notes=notes)
