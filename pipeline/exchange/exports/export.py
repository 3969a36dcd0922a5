"""Table of the export formats, and the export of a dataset to one of them, or of its passes.

Passes are OpenEXR files, one for each view, as datasets store them.

NVIDIA Energon: the shards as they are, with the metadata that `energon prepare` makes.

    SPLIT-NUMBER.tar, SPLIT-NUMBER.tar.idx, .nv-meta/{.info.json,split.yaml,dataset.yaml}

An index holds where each sample begins, and where the last one ends, as 64-bit integers. Samples
come as bytes by the suffixes of their members (`CrudeWebdataset`).
https://nvidia.github.io/Megatron-Energon/basic/data_prep.html

Scenes for other renderers and networks, with target pictures of matching names.

    KEY.h5                  RenderFormer's HDF5, for its inference, with the pictures
    KEY.json, objects/KEY   RenderFormer's scene with its meshes, for its converter
    KEY.usdc                USD
    KEY_view_VIEW.exr       the target of a view: linear radiance, half floats

The form `benchmark` writes all four, each into a folder of its name, and `views.csv` with a row for
each view. A target has the name that the published inference gives to its picture of `KEY.h5`, so
that the leaderboard reads those pictures unrenamed (`trilight leaderboard SET --pictures FOLDER`).
"""

import csv
import functools
import io
import os
import re
import shutil
import tarfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.exchange.convert import write_scene
from pipeline.exchange.exports.pictures import (
    write_coco,
    write_huggingface,
    write_hypersim,
    write_json,
    write_nerfstudio,
)
from pipeline.exchange.reader import SceneReader, scene_source
from pipeline.exchange.textured_triangles import LoadedScene
from storage.atomic import atomic_writer, write_atomically
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import ShardReader
from storage.errors import TrilightError
from storage.raycast import FirstHitCaster, Surfaces, require_row
from storage.records.exr import encode_exr
from storage.records.passes import passes_exr
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene

SCENE_SUFFIXES = {"h5": ".h5", "json": ".json", "usd": ".usdc"}
"""Suffix of the scene file of each format."""

TARGETS = "exr"
"""Format name of the target pictures, which have exactly the dataset's values."""

SCENE_FORMS = (*SCENE_SUFFIXES, TARGETS)

MOST_NOTES = 6
"""Maximum number of losses listed for each format; further ones are counted."""

_COLUMNS = ("scene", "view", "split", "h5", "json", "usd", "target", "noise_floor_db")


def picture_name(key: str, view: int) -> str:
    """Return the file name of a view's picture, such as `000000003_view_0.exr`."""
    return f"{key}_view_{view}.exr"


def _write_sample(form: str, sample: Sample, folder: Path) -> Sequence[str]:
    """Write a sample in a form into a folder; return sentences about losses."""
    if form == TARGETS:
        for view, radiance_rgb in enumerate(sample.radiance_rgb):
            write_atomically(folder / picture_name(sample.key, view), encode_exr(radiance_rgb))
        return ()
    target = folder / f"{sample.key}{SCENE_SUFFIXES[form]}"
    return write_scene(target, sample.scene, sample.radiance_rgb)


def write_scenes(samples: Iterator[tuple[str, Sample]], out: Path, form: str) -> Sequence[str]:
    """Write every sample in one format into a folder; return sentences about losses."""
    lost = dict.fromkeys(text for _, each in samples for text in _write_sample(form, each, out))
    return _limit_notes(form, list(lost))


def write_benchmark(samples: Iterator[tuple[str, Sample]], out: Path) -> Sequence[str]:
    """Write all formats and the table of views, in the layout of this module."""
    lost: dict[str, dict[str, None]] = {form: {} for form in SCENE_FORMS}
    stream = io.StringIO(newline="")
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(_COLUMNS)
    for split, sample in samples:
        for form in SCENE_FORMS:
            lost[form] |= dict.fromkeys(_write_sample(form, sample, out / form))
        scenes = [f"{form}/{sample.key}{suffix}" for form, suffix in SCENE_SUFFIXES.items()]
        for view, record in enumerate(sample.views):
            target = f"{TARGETS}/{picture_name(sample.key, view)}"
            floor = f"{record.noise_floor_db:.3f}"
            table.writerow([sample.key, view, split, *scenes, target, floor])
    write_atomically(out / "views.csv", stream.getvalue().encode())
    return [note for form, texts in lost.items() for note in _limit_notes(form, list(texts))]


def _limit_notes(form: str, lost: Sequence[str]) -> list[str]:
    notes = [f"{form} cannot hold {text}" for text in lost[:MOST_NOTES]]
    more = len(lost) - MOST_NOTES
    return [*notes, f"{form} loses {more} more things of this kind"] if more > 0 else notes


ExportForm = Literal[
    "nerfstudio",
    "coco",
    "huggingface",
    "hypersim",
    "energon",
    "h5",
    "json",
    "usd",
    "exr",
    "benchmark",
]

FORMS: dict[str, Callable[[Iterator[tuple[str, Sample]], Path], Sequence[str] | None]] = {
    "nerfstudio": write_nerfstudio,
    "coco": write_coco,
    "huggingface": write_huggingface,
    "hypersim": write_hypersim,
    **{form: functools.partial(write_scenes, form=form) for form in SCENE_FORMS},
    "benchmark": write_benchmark,
}
"""Writers by format. Each writes into a folder, index files last, and may return sentences about
losses."""

_RIGHTS = ("LICENSE.md", "attribution.csv")
"""Files of a dataset on rights, which every export contains."""


def export_dataset(
    source: str,
    form: ExportForm,
    out: Path,
    *,
    split: str | None,
    scene: str | None,
    done: Callable[[int], None],
) -> Sequence[str]:
    """Write samples of a dataset in a format of FORMS, with the rights of its objects.

    `out` is empty or does not exist; `split` and `scene` are those of `select_samples`. `done` is
    called after each sample with its number of views. The returned sentences tell what the format
    cannot hold.

    Raises:
        TrilightError: the dataset is unusable, there is no such split or scene, or the folder is
            not empty or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise TrilightError(f"--out is {out}, which is not empty; expected a new folder.")
    dataset = open_dataset(source)

    def samples() -> Iterator[tuple[str, Sample]]:
        for split_sample in select_samples(dataset, split=split, scene=scene):
            yield split_sample
            done(split_sample[1].scene.num_views)

    lost: Sequence[str] | None = None
    if form == "energon":  # takes the shards as they are
        if scene is not None:
            raise TrilightError(
                "--form energon copies whole shards, and --scene names a sample; leave it out, or "
                "make a dataset of it first (`trilight shards select`)."
            )
        write_energon(dataset, out, split, done)
    else:
        lost = FORMS[form](samples(), out)
    for name in _RIGHTS:
        if (data := dataset.store.get(name)) is not None:
            write_atomically(out / name, data)
    return lost or ()


_SPLITS = {"train": "train", "validation": "val", "test": "test"}
"""Names of the splits there."""

_PICTURE = re.compile(r"\d+\.exr")

_DATASET = {"__module__": "megatron.energon", "__class__": "CrudeWebdataset", "decoder": None}


def write_energon(
    dataset: Dataset, out: Path, split: str | None, done: Callable[[int], None]
) -> None:
    """Copy the shards of a split, or all, and write their metadata, in the layout of this module.

    `done` is called after each sample with its number of views.

    Raises:
        TrilightError: there is no such shard, or its bytes are not those of the manifest.
    """
    shards = dataset.shards_of(split)
    if not shards:
        raise TrilightError(
            f"{dataset.display_name}: no shard in split {split}; expected one of "
            f"{', '.join(sorted({shard.split for shard in dataset.manifest.shards}))}."
        )
    for shard in shards:
        _copy_shard(dataset, shard, out, done)
    splits = {
        name: [shard.name for shard in shards if shard.split == ours]
        for ours, name in _SPLITS.items()
    }
    meta = out / ".nv-meta"
    write_json(
        meta / ".info.json", {"shard_counts": {each.name: each.num_samples for each in shards}}
    )
    # JSON is YAML
    write_json(meta / "split.yaml", {"split_parts": splits, "exclude": []})
    write_json(meta / "dataset.yaml", _DATASET)


def _copy_shard(
    dataset: Dataset, shard: ShardEntry, out: Path, done: Callable[[int], None]
) -> None:
    target = out / shard.name
    with dataset.open_stream(shard, checked=True) as stream:
        with atomic_writer(target) as copy:
            shutil.copyfileobj(stream, copy)
        samples = list(ShardReader(stream, shard.name).samples.values())
    block = tarfile.BLOCKSIZE
    starts = [min(each.offset for each in members.values()) - block for members in samples]
    last = samples[-1].values() if samples else ()
    end = max((each.offset + each.num_bytes for each in last), default=0)
    index = [*starts, -(-end // block) * block]
    write_atomically(target.with_suffix(".tar.idx"), np.array(index, "<u8").tobytes())
    for members in samples:
        done(sum(_PICTURE.fullmatch(suffix) is not None for suffix in members))


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
    scene_key = sample_key(int(scene)) if scene is not None and scene.isdecimal() else scene
    has_samples = False
    for shard in dataset.shards_of(split):
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
