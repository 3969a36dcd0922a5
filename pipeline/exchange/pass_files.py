"""Writes passes of scenes as OpenEXR files, one for each view, as datasets store them."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from pipeline.exchange.reader import SceneReader, scene_source
from pipeline.exchange.textured_triangles import LoadedScene
from storage.atomic import write_atomically
from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset, open_dataset
from storage.errors import TrilightError
from storage.raycast.caster import FirstHitCaster, Surfaces
from storage.raycast.first_hits import require_row
from storage.records.passes.pictures import passes_exr
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene

_RESOLUTION = 256
"""Width and height in pixels for scenes without pictures."""


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
    caster: Callable[[Scene], FirstHitCaster] = Surfaces,
) -> tuple[str, ...]:
    """Write `SCENE.VIEW.passes.exr` into a folder for each chosen view; return notes.

    With Embree, and the resolution and single ray of a dataset that stores the same passes, the
    files equal the stored ones byte for byte. On a GPU a pixel on a rim may show the neighboring
    triangle.

    Args:
        source: a dataset (folder or URL), or a scene in any form that `trilight convert` reads.
        out: the folder, which is created.
        names: of the passes.
        scene, view: key of the only scene, with or without zeros, and the only view; None for all.
        resolution: width and height in pixels; None for that of the dataset's pictures, or 256.
        rays_a_side: rays along each side of a pixel.
        done: called with each written file.
        caster: returns what finds the triangles that cameras of a scene see.

    Raises:
        TrilightError: the source is unusable, there is no such scene, view or pass, or the folder
            cannot be written.
    """
    notes: list[str] = []
    for name, loaded, size in _scenes(source, scene):
        notes += loaded.notes
        surfaces = caster(loaded.scene)
        for row in range(loaded.scene.num_views) if view is None else [view]:
            require_row("view", row, loaded.scene.num_views)
            path = out / f"{name}.{row}.passes.exr"
            data = passes_exr(
                loaded.scene,
                names,
                view=row,
                resolution=resolution or size,
                rays_a_side=rays_a_side,
                surfaces=surfaces,
            )
            write_atomically(path, data)
            done(path)
    return tuple(dict.fromkeys(notes))


def _scenes(source: str, key: str | None) -> Iterator[tuple[str, LoadedScene, int]]:
    """Yield scenes of a source with their file names and resolutions."""
    if "://" in source or os.path.isdir(source):
        for _, sample in select_samples(open_dataset(source), scene=key):
            loaded = LoadedScene(scene=sample.scene, notes=())
            yield sample.key, loaded, sample.radiance_rgb.shape[2]
        return
    with SceneReader() as reader:
        whole_source = scene_source(source if key is None else f"{source}::{key}", many=True)
        for each in reader.scenes_of(whole_source):
            name = each.path.stem if each.key is None else each.key
            yield name, reader.load(each), _RESOLUTION


def select_samples(
    dataset: Dataset, *, split: str | None = None, scene: str | None = None
) -> Iterator[tuple[str, Sample]]:
    """Yield (split, sample) of a dataset in its order, with pictures.

    `split` and `scene` choose one; the key of a scene may lack the zeros before it.

    Raises:
        TrilightError: the split or scene does not exist, or the dataset is empty or damaged.
    """
    if split is not None and split not in SPLITS:
        raise TrilightError(f"split is {split!r}; expected one of {', '.join(SPLITS)}.")
    scene_key = sample_key(int(scene)) if scene is not None and scene.isdecimal() else scene
    has_samples = False
    for shard in dataset.manifest.shards:
        if split not in (None, shard.split):
            continue
        keys = [key for key in dataset.keys(shard) if scene_key in (None, key)]
        has_samples = has_samples or bool(keys)
        for sample in dataset.read_samples(shard, keys):
            yield shard.split, sample
    if not has_samples:
        which = f"scene {scene_key}" if scene_key else "scene"
        where = "" if split is None else f" in split {split}"
        raise TrilightError(
            f"{dataset.display_name}: no {which}{where}; expected one of its "
            f"{dataset.manifest.num_samples}. List them with `trilight inspect`."
        )
