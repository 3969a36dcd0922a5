"""Table of the export formats, and the export of a dataset to one of them.

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
from pipeline.exchange.pass_files import select_samples
from storage.atomic import atomic_writer, write_atomically
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import ShardReader
from storage.errors import TrilightError
from storage.records.exr import encode_exr
from storage.records.sample import Sample

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
    folder.mkdir(parents=True, exist_ok=True)
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
    shards = [shard for shard in dataset.manifest.shards if split in (None, shard.split)]
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
    target.parent.mkdir(parents=True, exist_ok=True)
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
