"""What is known of each scene of a dataset without loading it: read once, in the background.

Of a scene the record is read, and of its arrays no more than the header that says how many
triangles there are. All rows stay in memory, a few hundred bytes each.
"""

import json
import struct
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, BinaryIO

import numpy as np

from storage.dataset.dataset import Dataset, reading
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import Member, contents_of, read_member
from storage.errors import TrilightError
from storage.records.profiles import PACKED, PLAIN

MOST_SCENES = 500_000
"""Rows that are held; of a larger dataset the first ones."""

_MOST_HEADER = 1 << 20

_PATIENCE_S = 20.0
"""How long a scene is waited for that is not read yet."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneRow:
    """One scene."""

    key: str
    shard: int
    """Row of the manifest's shards."""
    split: str
    template: str
    views: int
    triangles: int
    lights: int
    """Emitter objects."""
    floor: float
    """Noise floor of the worst view, psnr_log_db."""
    coverage: float
    """Least share of a view on objects."""
    spp: int
    """Most samples per pixel of a view."""


SORTED_BY: Mapping[str, Callable[[SceneRow], Any]] = {
    name: attrgetter(name, "key")
    for name in ("key", "split", "template", "triangles", "lights", "floor", "coverage", "spp")
}
"""What rows may be sorted by."""


class DatasetIndex:
    """The rows of a dataset so far."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._rows: list[SceneRow] = []
        self._by_key: dict[str, SceneRow] = {}
        self._closed = False
        self.shards_read = 0
        self.problems: list[str] = []
        """Shards that could not be read, each with a sentence."""
        self._thread = threading.Thread(target=self._read_all, daemon=True)

    def begin(self) -> None:
        """Start to read."""
        self._thread.start()

    def wait(self) -> None:
        """Wait until all is read."""
        self._thread.join()

    def close(self) -> None:
        """Stop reading."""
        self._closed = True

    @property
    def rows(self) -> list[SceneRow]:
        """All rows so far, in the order of the shards."""
        return self._rows[:]

    def row(self, key: str) -> SceneRow:
        """Return the row of a scene, which is waited for; TrilightError where it does not come."""
        deadline = time.monotonic() + _PATIENCE_S
        while key not in self._by_key:
            if not self._thread.is_alive():
                raise TrilightError(f"scene {key:.40}: not in the dataset.")
            if time.monotonic() > deadline:
                raise TrilightError(f"scene {key:.40}: not read yet; ask for it again.")
            self._thread.join(0.05)
        return self._by_key[key]

    def _read_all(self) -> None:
        for number, shard in enumerate(self._dataset.manifest.shards):
            if self._closed or len(self._rows) >= MOST_SCENES:
                break
            try:
                self._read_shard(number, shard)
            except (TrilightError, OSError) as error:
                self.problems.append(str(error))
            self.shards_read += 1

    def _read_shard(self, number: int, shard: ShardEntry) -> None:
        dataset = self._dataset
        with dataset.files.open(shard, checked=False) as stream:
            with reading(dataset.shown, shard.name):
                samples = contents_of(stream, shard.name).samples
            for key, members in samples.items():
                if self._closed:
                    return
                with reading(dataset.shown, shard.name):
                    row = _row(stream, key, members, number, shard.split)
                self._rows.append(row)
                self._by_key[key] = row


def _row(
    stream: BinaryIO, key: str, members: Mapping[str, Member], shard: int, split: str
) -> SceneRow:
    record = json.loads(read_member(stream, members["json"]))
    views = record["views"]
    return SceneRow(
        key=key,
        shard=shard,
        split=split,
        template=str(record["provenance"]["template"]),
        views=len(views),
        triangles=_num_triangles(stream, members),
        lights=sum(entry["kind"] == "emitter" for entry in record["objects"]),
        floor=min(_single(view["noise_floor_db"]) for view in views),
        coverage=min(_single(view["coverage"]) for view in views),
        spp=max(int(view["spp"]) for view in views),
    )


def _num_triangles(stream: BinaryIO, members: Mapping[str, Member]) -> int:
    suffix = PLAIN if PLAIN in members else PACKED
    stream.seek(members[suffix].offset)
    head = stream.read(min(members[suffix].num_bytes, _MOST_HEADER))
    if suffix == PACKED:
        head = zlib.decompressobj(31).decompress(head, _MOST_HEADER)
    (length,) = struct.unpack("<Q", head[:8])
    shapes = json.loads(head[8 : 8 + length])
    return int(shapes["faces"]["shape"][0])


def _single(value: Any) -> float:
    """Return a number as `trilight shards select` compares it."""
    return float(np.float32(value))
