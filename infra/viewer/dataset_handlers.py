"""Request handlers of a dataset's page: rows, thumbnails, and any scene as a page below it."""

import dataclasses
import functools
import json
import re
import shlex
import threading
import time
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from infra.render.path_tracer import RenderChild
from infra.viewer.scene_handlers import (
    MOST_THUMBNAILS,
    SceneHandlers,
    SceneListHandlers,
    handlers_of_scene,
    thumbnail_png,
)
from infra.viewer.server import NotFound, Request, Response, Routes, json_response
from pipeline.exchange.formats import LoadedScene
from pipeline.generation.derive_dataset import Selection, columns_of
from pipeline.shards.finished_dataset import SceneFacts
from storage.dataset.dataset import Dataset, reading
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import Member, ShardReader
from storage.errors import TrilightError, expected_one_of
from storage.records.exr import decode_exr
from storage.records.profiles import PACKED, PLAIN
from storage.records.safe_read import safetensors_header, unpack_gzip
from storage.remote.safe_url import safe_url
from storage.settings.overrides import option_words

MOST_SCENES = 500_000
"""Maximum number of rows; a larger dataset is cut."""

_MOST_HEADER = 1 << 20

_PATIENCE_S = 20.0
"""Seconds to wait for a scene that is not read yet."""

SORTS = ("key", "split", "template", "triangles", "lights", "floor", "coverage", "spp")
"""Columns by which rows are sorted."""

_OF_VIEWS = ("coverage", "noise_floor_db", "noise_floor_linear_db", "spp")
"""Quantities of a view that the index holds."""

_NAMES = {"key", "split", "template", "triangles_per_scene", "lights_per_scene", *_OF_VIEWS}
"""Names of the values that conditions may use."""


class SceneRow(NamedTuple):
    """Row of the index."""

    facts: SceneFacts
    """Facts of the scene, without the digest of its arrays and without its objects."""
    columns: Mapping[str, Any]
    """Values of the page: those of `trilight shards list`, and the number of views."""


class DatasetIndex:
    """Growing index of a dataset's scenes, which a thread reads."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._rows: list[SceneRow] = []
        self._by_key: dict[str, SceneRow] = {}
        self._closed = False
        self.shards_read = 0
        self.problems: list[str] = []
        """Messages on shards that could not be read."""
        self._thread = threading.Thread(target=self._read_all, daemon=True)
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
        for shard in self._dataset.manifest.shards:
            if self._closed or len(self._rows) >= MOST_SCENES:
                break
            try:
                self._read_shard(shard)
            except (TrilightError, OSError) as error:
                self.problems.append(str(error))
            self.shards_read += 1

    def _read_shard(self, shard: ShardEntry) -> None:
        dataset = self._dataset
        with dataset.open_shard(shard) as opened:
            for key in opened.samples:
                if self._closed:
                    return
                with reading(dataset.display_name, shard.name):
                    row = _row(opened, key, shard)
                self._rows.append(row)
                self._by_key[key] = row


def _row(opened: ShardReader, key: str, shard: ShardEntry) -> SceneRow:
    members = opened.samples[key]
    record = json.loads(opened.read(members["json"]))
    values: dict[str, Any] = {
        "key": key,
        "split": shard.split,
        "template": str(record["provenance"].get("template", "unknown")),
        "triangles_per_scene": _num_triangles(opened, members),
        "lights_per_scene": sum(entry["kind"] == "emitter" for entry in record["objects"]),
    }
    for name in _OF_VIEWS:  # as single numbers, like those that `trilight shards select` compares
        values[name] = array("f", [view[name] for view in record["views"]])
    facts = SceneFacts(
        shard=shard,
        key=key,
        template=values["template"],
        noise_floor_db=min(values["noise_floor_db"]),
        uids=(),
        arrays_sha256="",
        values=values,
    )
    views = len(record["views"])
    return SceneRow(facts, {"key": key, "views": views, **columns_of(values)})


def _num_triangles(opened: ShardReader, members: Mapping[str, Member]) -> int:
    suffix = PLAIN if PLAIN in members else PACKED
    num_bytes = min(members[suffix].num_bytes, _MOST_HEADER)
    head = opened.read(dataclasses.replace(members[suffix], num_bytes=num_bytes))
    if suffix == PACKED:
        head = unpack_gzip(head, _MOST_HEADER, suffix, is_whole=False)
    return int(safetensors_header(head, name=suffix)["faces"]["shape"][0])


def selection_of(query: Mapping[str, str]) -> Selection:
    """Return the selection of a query, whose `split`, `template` and `where` are as in commands.

    Raises:
        TrilightError: a condition is malformed, or on values that the index does not hold.
    """
    stated = {name: query.get(name) or None for name in ("split", "template", "where")}
    selection = Selection(**stated)  # type: ignore[arg-type]
    if (where := selection.condition()) and (unknown := sorted(where.names - _NAMES)):
        raise TrilightError(f"{unknown[0]}: not in the page's index; use trilight shards list.")
    return selection


def sorted_rows(
    rows: Sequence[SceneRow], selection: Selection, query: Mapping[str, str]
) -> list[SceneRow]:
    """Return the selected rows in the order of a query, by `sort` and `descending`.

    Raises:
        TrilightError: the sort column is unknown.
    """
    sort = query.get("sort", "key")
    if sort not in SORTS:
        raise TrilightError(f"sort is {sort:.40}; {expected_one_of(sort, SORTS)}.")
    where = selection.condition()
    taken = [
        row
        for row in rows
        if selection.takes(row.facts) and (where is None or where.holds(row.facts.values))
    ]
    backwards = query.get("descending") == "1"
    return sorted(taken, key=lambda row: (row.columns[sort], row.facts.key), reverse=backwards)


MOST_ROWS = 200
"""Maximum number of scenes in one response."""

_WIDEST = 1024


class DatasetHandlers(SceneListHandlers):
    """Handlers of a dataset, and of its scenes that are open."""

    key = re.compile(r"[0-9A-Za-z_\-]+")

    def __init__(
        self, dataset: Dataset, source: str, child: RenderChild, checkpoint: str | None
    ) -> None:
        """Start to read the index.

        Args:
            dataset: opened dataset.
            source: folder or URL of the dataset, as the user named it.
            child, checkpoint: render child and network for the pages of its scenes.
        """
        super().__init__(child, checkpoint)
        self._dataset = dataset
        self._source = source
        self._png = functools.lru_cache(MOST_THUMBNAILS)(self._small_png)
        self.index = DatasetIndex(dataset)

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""
        return {
            **super().routes(),
            "GET api/dataset": self._facts,
            "GET api/rows": self._rows,
        }

    def close(self) -> None:
        """Stop reading and rendering."""
        self.index.close()
        super().close()

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
                "splits": sorted({row.facts.shard.split for row in rows}),
                "templates": sorted({row.facts.template for row in rows}),
                "problems": self.index.problems[:5],
            }
        )

    def _rows(self, request: Request) -> Response:
        query = request.query
        every = self.index.rows
        selection = selection_of(query)
        matching = sorted_rows(every, selection, query)
        first = int(query["from"]) if query.get("from", "").isdecimal() else 0
        page = matching[first : first + MOST_ROWS]
        return json_response(
            {
                "of": len(every),
                "total": len(matching),
                "rows": [row.columns for row in page],
                "command": self._command(option_words(selection)),
            }
        )

    def _command(self, options: Sequence[str]) -> str:
        """Return the command that selects the matching scenes; empty without conditions."""
        if not self._dataset.local or not options:
            return ""
        root = Path(self._source)
        out = root.with_name(f"{root.resolve().name}-selected")
        return shlex.join(["trilight", "shards", "select", str(root), *options, "--out", str(out)])

    def _thumbnail(self, request: Request) -> Response:
        key, _, view = request.path.removeprefix("api/thumbnail/").partition("/")
        row = self.index.row(key)
        width = request.query.get("px", "160")
        if not view.isdecimal() or int(view) >= row.columns["views"]:
            raise NotFound("the scene has no such view.")
        if not width.isdecimal() or not 16 <= int(width) <= _WIDEST:
            raise TrilightError(f"px is {width:.10}; expected 16 to {_WIDEST}.")
        return Response(body=self._png(key, int(view), int(width)), kind="image/png")

    def _small_png(self, key: str, view: int, width: int) -> bytes:
        shard = self.index.row(key).facts.shard
        with (
            self._dataset.open_shard(shard) as opened,
            reading(self._dataset.display_name, shard.name),
        ):
            radiance_rgb = decode_exr(opened.read(opened.samples[key][f"{view}.exr"]))
        return thumbnail_png(radiance_rgb, width)

    def _open_scene(self, key: str) -> SceneHandlers:
        shard = self.index.row(key).facts.shard
        (sample,) = self._dataset.read_samples(shard, [key])
        floors = [view.noise_floor_db for view in sample.views]
        loaded = LoadedScene(scene=sample.scene, notes=(), radiance_rgb=sample.radiance_rgb)
        place = f"{Path(self._source) / shard.name}::{key}" if self._dataset.local else ""
        name = f"scene {key}, {shard.split}"
        return handlers_of_scene(name, loaded, place, self._child, self._checkpoint, floors)
