"""NVIDIA Energon export: the shards as they are, with the metadata that `energon prepare` makes.

    SPLIT-NUMBER.tar, SPLIT-NUMBER.tar.idx, .nv-meta/{.info.json,split.yaml,dataset.yaml}

An index holds where each sample begins, and where the last one ends, as 64-bit integers. Samples
come as bytes by the suffixes of their members (`CrudeWebdataset`).
https://nvidia.github.io/Megatron-Energon/basic/data_prep.html
"""

import re
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline.exchange.exports.pictures import write_json
from storage.atomic import atomic_writer, write_atomically
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import ShardReader
from storage.errors import TrilightError

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
    splits: dict[str, list[str]] = {name: [] for name in _SPLITS.values()}
    for shard in shards:
        splits[_SPLITS[shard.split]].append(shard.name)
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
