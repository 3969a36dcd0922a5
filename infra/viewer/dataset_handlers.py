"""Request handlers of a dataset's page: rows, thumbnails, and any scene as a page below it."""

import dataclasses
import functools
import json
import math
import operator
import re
import shlex
import struct
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from infra.render.path_tracer import RenderChild
from infra.viewer.scene_handlers import (
    MOST_THUMBNAILS,
    OpenScenes,
    SceneHandlers,
    handlers_of_scene,
    thumbnail_png,
)
from infra.viewer.server import NotFound, Request, Response, Routes, json_response
from pipeline.exchange.formats import LoadedScene
from storage.dataset.dataset import Dataset, reading
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import Member, ShardReader
from storage.errors import TrilightError, expected_one_of
from storage.records.exr import decode_exr
from storage.records.profiles import PACKED, PLAIN
from storage.remote.safe_url import safe_url

MOST_SCENES = 500_000
"""Maximum number of rows; a larger dataset is cut."""

_MOST_HEADER = 1 << 20

_PATIENCE_S = 20.0
"""Seconds to wait for a scene that is not read yet."""

_WHERE = {
    "triangles": "triangles_per_scene",
    "lights": "lights_per_scene",
    "coverage": "min(coverage)",
    "floor": "min(noise_floor_db)",
}
"""Columns with limits, by their quantity in `trilight shards select --where`."""

_ENDS = {">=": ("min", operator.ge), "<=": ("max", operator.le)}
"""Suffix of a limit in a query, and its comparison, by the sign in a condition."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneRow:
    """Facts of one scene."""

    key: str
    shard: int
    """Index of the shard in the manifest."""
    split: str
    template: str
    views: int
    triangles: int
    lights: int
    """Number of emitter objects, not of their triangles."""
    floor: float
    """Stated error of the worst view as psnr_log_db."""
    coverage: float
    """Least fraction over the views of pixels on objects."""
    spp: int
    """Greatest number of samples per pixel over the views."""


SORTED_BY: Mapping[str, Callable[[SceneRow], Any]] = {
    name: attrgetter(name, "key")
    for name in ("key", "split", "template", "triangles", "lights", "floor", "coverage", "spp")
}
"""Sort key of rows by column."""


class DatasetIndex:
    """Growing index of a dataset's scenes."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._rows: list[SceneRow] = []
        self._by_key: dict[str, SceneRow] = {}
        self._closed = False
        self.shards_read = 0
        self.problems: list[str] = []
        """Messages on shards that could not be read."""
        self._thread = threading.Thread(target=self._read_all, daemon=True)

    def begin(self) -> None:
        """Start the reading thread."""
        self._thread.start()

    def wait(self) -> None:
        """Wait until all shards are read."""
        self._thread.join()

    def close(self) -> None:
        """Stop reading."""
        self._closed = True

    @property
    def rows(self) -> list[SceneRow]:
        """All rows so far, in the order of the shards."""
        return self._rows[:]

    def row(self, key: str) -> SceneRow:
        """Wait for the row of a scene, and return it; raises TrilightError without one."""
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
        with dataset.open_shard(shard) as opened:
            for key in opened.samples:
                if self._closed:
                    return
                with reading(dataset.display_name, shard.name):
                    row = _row(opened, key, number, shard.split)
                self._rows.append(row)
                self._by_key[key] = row


def _row(opened: ShardReader, key: str, shard: int, split: str) -> SceneRow:
    members = opened.samples[key]
    record = json.loads(opened.read(members["json"]))
    views = record["views"]
    return SceneRow(
        key=key,
        shard=shard,
        split=split,
        template=str(record["provenance"].get("template", "unknown")),
        views=len(views),
        triangles=_num_triangles(opened, members),
        lights=sum(entry["kind"] == "emitter" for entry in record["objects"]),
        floor=min(_single(view["noise_floor_db"]) for view in views),
        coverage=min(_single(view["coverage"]) for view in views),
        spp=max(int(view["spp"]) for view in views),
    )


def _num_triangles(opened: ShardReader, members: Mapping[str, Member]) -> int:
    suffix = PLAIN if PLAIN in members else PACKED
    num_bytes = min(members[suffix].num_bytes, _MOST_HEADER)
    head = opened.read(dataclasses.replace(members[suffix], num_bytes=num_bytes))
    if suffix == PACKED:
        head = zlib.decompressobj(31).decompress(head, _MOST_HEADER)
    (length,) = struct.unpack("<Q", head[:8])
    shapes = json.loads(head[8 : 8 + length])
    return int(shapes["faces"]["shape"][0])


def _single(value: Any) -> float:
    """Return a number as `trilight shards select` compares it."""
    return float(np.float32(value))


@dataclass(frozen=True, kw_only=True)
class SceneFilter:
    """Conditions and order of a dataset's page."""

    split: str = ""
    """Split of the scenes; empty for all splits."""
    template: str = ""
    """Layout of the scenes; empty for all layouts."""
    limits: Sequence[tuple[str, str, float]]
    """Column, `>=` or `<=`, and value of each limit."""
    sort: str = "key"
    descending: bool = False

    def rows(self, rows: Sequence[SceneRow]) -> list[SceneRow]:
        """Return the rows that meet the conditions, sorted."""
        matching = [row for row in rows if self._matches(row)]
        return sorted(matching, key=SORTED_BY[self.sort], reverse=self.descending)

    def command(self, dataset: Path, out: Path) -> str:
        """Return the command that selects the matching scenes; empty without conditions."""
        words = ["trilight", "shards", "select", str(dataset)]
        conditions = [f"{_WHERE[name]} {sign} {value:g}" for name, sign, value in self.limits]
        options = {"--split": self.split, "--template": self.template}
        options["--where"] = " and ".join(conditions)
        chosen = [word for option, value in options.items() if value for word in (option, value)]
        return shlex.join([*words, *chosen, "--out", str(out)]) if chosen else ""

    def _matches(self, row: SceneRow) -> bool:
        return (
            self.split in ("", row.split)
            and self.template in ("", row.template)
            and all(_ENDS[sign][1](getattr(row, name), value) for name, sign, value in self.limits)
        )


def filter_of(query: Mapping[str, str]) -> SceneFilter:
    """Return the filter of a query.

    Args:
        query: `split`, `template`, `sort`, `descending`, and `COLUMN_min` and `COLUMN_max`.

    Raises:
        TrilightError: a limit is no number, or the sort column is unknown.
    """
    sort = query.get("sort", "key")
    if sort not in SORTED_BY:
        raise TrilightError(f"sort is {sort:.40}; {expected_one_of(sort, list(SORTED_BY))}.")
    limits = [
        (name, sign, _number(query[f"{name}_{end}"], name))
        for sign, (end, _) in _ENDS.items()
        for name in _WHERE
        if query.get(f"{name}_{end}")
    ]
    return SceneFilter(
        split=query.get("split", ""),
        template=query.get("template", ""),
        limits=limits,
        sort=sort,
        descending=query.get("descending") == "1",
    )


def _number(text: str, name: str) -> float:
    try:
        # rounded as in the command, so that both select the same scenes
        value = float(f"{float(text):g}")
    except ValueError as error:
        raise TrilightError(f"{name}: {text:.20} is no number.") from error
    if not math.isfinite(value):
        raise TrilightError(f"{name}: {text:.20} is no finite number.")
    return value


MOST_ROWS = 200
"""Maximum number of scenes in one response."""

_WIDEST = 1024
_KEY = re.compile(r"[0-9A-Za-z_\-]+")


class DatasetHandlers:
    """Handlers of a dataset, and of its scenes that are open."""

    def __init__(
        self, dataset: Dataset, source: str, child: RenderChild, checkpoint: str | None
    ) -> None:
        """Start to read the index.

        Args:
            dataset: opened dataset.
            source: folder or URL of the dataset, as the user named it.
            child, checkpoint: render child and network for the pages of its scenes.
        """
        self._dataset = dataset
        self._source = source
        self._child = child
        self._checkpoint = checkpoint
        self._png = functools.lru_cache(MOST_THUMBNAILS)(self._small_png)
        self._scenes = OpenScenes(_KEY, self._open_scene)
        self.index = DatasetIndex(dataset)
        self.index.begin()

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""
        return {
            "GET api/dataset": self._facts,
            "GET api/rows": self._rows,
            "GET api/thumbnail/": self._thumbnail,
            "GET scene/": self._scenes.respond,
            "POST scene/": self._scenes.respond,
        }

    def close(self) -> None:
        """Stop reading and rendering."""
        self.index.close()
        self._scenes.close()
        self._child.close()

    def _facts(self, _: Request) -> Response:
        manifest = self._dataset.manifest
        rows = self.index.rows
        return json_response(
            {
                "name": safe_url(self._source),
                "build": manifest.build,
                "scenes": manifest.num_samples,
                "indexed": len(rows),
                "shards": len(manifest.shards),
                "shards_read": self.index.shards_read,
                "splits": sorted({row.split for row in rows}),
                "templates": sorted({row.template for row in rows}),
                "problems": self.index.problems[:5],
            }
        )

    def _rows(self, request: Request) -> Response:
        query = request.query
        every = self.index.rows
        chosen = filter_of(query)
        matching = chosen.rows(every)
        first = int(query["from"]) if query.get("from", "").isdecimal() else 0
        page = matching[first : first + MOST_ROWS]
        return json_response(
            {
                "of": len(every),
                "total": len(matching),
                "rows": [dataclasses.asdict(row) for row in page],
                "command": self._command(chosen),
            }
        )

    def _command(self, chosen: SceneFilter) -> str:
        if not self._dataset.local:
            return ""
        root = Path(self._source)
        return chosen.command(root, root.with_name(f"{root.resolve().name}-selected"))

    def _thumbnail(self, request: Request) -> Response:
        key, _, view = request.path.removeprefix("api/thumbnail/").partition("/")
        row = self.index.row(key)
        width = request.query.get("px", "160")
        if not view.isdecimal() or int(view) >= row.views:
            raise NotFound("the scene has no such view.")
        if not width.isdecimal() or not 16 <= int(width) <= _WIDEST:
            raise TrilightError(f"px is {width:.10}; expected 16 to {_WIDEST}.")
        return Response(body=self._png(row, int(view), int(width)), kind="image/png")

    def _small_png(self, row: SceneRow, view: int, width: int) -> bytes:
        shard = self._dataset.manifest.shards[row.shard]
        with (
            self._dataset.open_shard(shard) as opened,
            reading(self._dataset.display_name, shard.name),
        ):
            radiance_rgb = decode_exr(opened.read(opened.samples[row.key][f"{view}.exr"]))
        return thumbnail_png(radiance_rgb, width)

    def _open_scene(self, key: str) -> SceneHandlers:
        row = self.index.row(key)
        shard = self._dataset.manifest.shards[row.shard]
        (sample,) = self._dataset.read_samples(shard, [key])
        floors = [view.noise_floor_db for view in sample.views]
        loaded = LoadedScene(scene=sample.scene, notes=(), radiance_rgb=sample.radiance_rgb)
        place = f"{Path(self._source) / shard.name}::{key}" if self._dataset.local else ""
        name = f"scene {key}, {row.split}"
        return handlers_of_scene(name, loaded, place, self._child, self._checkpoint, floors)
