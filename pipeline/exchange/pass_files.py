"""Writes passes of scenes as OpenEXR files, one for each view, as datasets store them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.exchange.select_samples import is_dataset, select_samples
from storage.atomic import write_atomically
from storage.dataset.dataset import open_dataset
from storage.raycast.first_hits import require_row
from storage.records.passes.pictures import passes_exr
from storage.records.scene import Scene

_RESOLUTION = 256
"""Width and height in pixels for scenes without pictures."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _NamedScene:
    """A scene of a source with its file name."""

    name: str
    scene: Scene
    resolution: int
    notes: tuple[str, ...] = ()


def write_passes(
    source: str,
    out: Path,
    names: Sequence[str],
    *,
    scene: str | None,
    view: int | None,
    resolution: int | None,
    rays_a_side: int,
    done: Callable[[Path], None],
) -> tuple[str, ...]:
    """Write `SCENE.VIEW.passes.exr` into a folder for each chosen view; return notes.

    With the resolution and the single ray of a dataset that stores the same passes, the files equal
    the stored ones byte for byte.

    Args:
        source: a dataset (folder or URL), or a scene in any form that `trilight convert` reads.
        out: the folder, which is created.
        names: of the passes.
        scene: key of the only scene, with or without zeros before it; None for all.
        view: the only view; None for all.
        resolution: width and height in pixels; None for that of the dataset's pictures, or 256.
        rays_a_side: rays along each side of a pixel.
        done: called with each written file.

    Raises:
        TrilightError: the source is unusable, there is no such scene, view or pass, or the folder
            cannot be written.
    """
    notes: list[str] = []
    for named in _scenes(source, scene):
        notes += named.notes
        for row in range(named.scene.num_views) if view is None else [view]:
            require_row("view", row, named.scene.num_views)
            path = out / f"{named.name}.{row}.passes.exr"
            data = passes_exr(
                named.scene,
                names,
                view=row,
                resolution=resolution or named.resolution,
                rays_a_side=rays_a_side,
            )
            write_atomically(path, data)
            done(path)
    return tuple(dict.fromkeys(notes))


def _scenes(source: str, key: str | None) -> Iterator[_NamedScene]:
    if is_dataset(source):
        for _, sample in select_samples(open_dataset(source), scene=key):
            resolution = sample.radiance_rgb.shape[2]
            yield _NamedScene(name=sample.key, scene=sample.scene, resolution=resolution)
        return
    with SceneReader() as reader:
        whole_source = scene_source(source if key is None else f"{source}::{key}", many=True)
        for each in reader.scenes_of(whole_source):
            loaded = reader.load(each)
            name = each.path.stem if each.key is None else each.key
            yield _NamedScene(
                name=name, scene=loaded.scene, resolution=_RESOLUTION, notes=loaded.notes
            )
