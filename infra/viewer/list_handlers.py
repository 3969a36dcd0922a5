"""Request handlers of the pages of many scenes: a dataset or a folder, and any scene below it.

The page of a dataset has its rows and thumbnails from the shards. A file of a folder is read when
its row becomes visible, by one child with limits; its thumbnail has few samples.
"""

import dataclasses
import functools
import json
import re
import shlex
import threading
import time
from abc import ABC, abstractmethod
from array import array
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from starlette.responses import JSONResponse, Response

from infra.render.path_tracer import PathTracer, RenderChild
from infra.viewer.open_source import scene_list
from infra.viewer.page_renderers import page_renderers
from infra.viewer.scene_handlers import SceneHandlers
from infra.viewer.server import NotFound, Request, Routes, dispatch, static_routes
from pipeline.documents.png import encode_png
from pipeline.documents.scene_page import preview
from pipeline.exchange.formats import LoadedScene
from pipeline.exchange.reader import SceneReader, scene_source
from pipeline.generation.derive_dataset import Selection, columns_of
from pipeline.renders.preview import PreviewSettings
from pipeline.shards.finished_dataset import SceneFacts
from storage.aliases import PRESET_ALIASES, name_for_people
from storage.conventions import preview_gain
from storage.dataset.dataset import Dataset, reading
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import Member, ShardReader
from storage.errors import TrilightError, expected_one_of
from storage.records.exr import decode_exr
from storage.records.lights import num_lights
from storage.records.profiles import PACKED, PLAIN
from storage.records.safe_read import safetensors_header, unpack_gzip
from storage.remote.url import safe_url
from storage.renderer import Camera
from storage.settings.overrides import option_words

MOST_OPEN = 3
"""Maximum number of scenes whose pages stay open."""

MOST_THUMBNAILS = 1000
"""Maximum number of small pictures that a page keeps."""

_BELOW = re.compile(r"scene/([^/]+)/(.*)", re.DOTALL)


def thumbnail_png(radiance_rgb: NDArray[np.float32], width: int) -> bytes:
    """Return a picture [R, R, 3] of linear radiance as a small PNG, exposed for looking."""
    return encode_png(preview(radiance_rgb * preview_gain(radiance_rgb), width))


class SceneListHandlers(ABC):
    """Handlers of a page of many scenes: thumbnails, and the page of a scene at `scene/KEY/`."""

    key: re.Pattern[str]
    """Pattern of the keys of scenes."""

    def __init__(self, child: RenderChild, checkpoint: str | None) -> None:
        """Open no scene yet; render child and checkpoint are for the pages of the scenes."""
        self._child = child
        self._checkpoint = checkpoint
        self._opening = threading.Lock()
        self._open = OrderedDict[str, SceneHandlers]()

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""
        return {
            "GET api/thumbnail/": self._thumbnail,
            "GET scene/": self._below,
            "POST scene/": self._below,
        }

    def close(self) -> None:
        """Stop rendering, and wait for its end."""
        for room in self._open.values():
            room.close()
        self._child.close()

    @abstractmethod
    def _thumbnail(self, request: Request) -> Response:
        """Respond with the small picture of a scene."""

    @abstractmethod
    def _open_scene(self, key: str) -> SceneHandlers:
        """Return the handlers of a scene; raises TrilightError without such a scene."""

    def _below(self, request: Request) -> Response:
        """Respond to a request below a scene's page; the most recent scenes stay open."""
        match = _BELOW.fullmatch(request.path)
        if match is None or not self.key.fullmatch(match[1]):
            raise NotFound("there is no such scene.")
        key = match[1]
        with self._opening:
            room = self._open.pop(key, None) or self._open_scene(key)
            self._open[key] = room
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].queue.cancel_all()
        below = dataclasses.replace(request, path=match[2])
        return dispatch({**static_routes("scene.html"), **room.routes()}, below)


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
                with self._dataset.open_shard(shard) as opened:
                    for key in opened.samples:
                        if self._closed:
                            return
                        with reading(self._dataset.display_name, shard.name):
                            row = _row(self._dataset, opened, key, shard)
                        self._rows.append(row)
                        self._by_key[key] = row
            except (TrilightError, OSError) as error:
                self.problems.append(str(error))
            self.shards_read += 1


def _row(dataset: Dataset, opened: ShardReader, key: str, shard: ShardEntry) -> SceneRow:
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
        dataset=dataset,
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


def selected_rows(
    rows: Sequence[SceneRow], query: Mapping[str, str]
) -> tuple[list[SceneRow], Sequence[str]]:
    """Return the rows that a query selects, in its order, and the options of commands that do so.

    Args:
        query: `split`, `template` and `where` as in commands, and `sort` and `descending`.

    Raises:
        TrilightError: a condition is malformed, or on values that the index does not hold; or the
            sort column is unknown.
    """
    names = ("split", "template", "where")
    stated = {name: query[name] for name in names if query.get(name, "") not in ("", "none")}
    selection = Selection(**stated)  # type: ignore[arg-type]
    where = selection.condition
    if where is not None and (unknown := sorted(where.names - _NAMES)):
        raise TrilightError(f"{unknown[0]}: not in the page's index; use trilight shards list.")
    sort = query.get("sort", "key")
    if sort not in SORTS:
        raise TrilightError(f"sort is {sort:.40}; {expected_one_of(sort, SORTS)}.")
    taken = [row for row in rows if selection.takes(row.facts)]
    backwards = query.get("descending") == "1"
    taken.sort(key=lambda row: (row.columns[sort], row.facts.key), reverse=backwards)
    return taken, option_words(selection)


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
        return JSONResponse(
            {
                "name": safe_url(self._source),
                "build": name_for_people(manifest.build, PRESET_ALIASES),
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
        matching, words = selected_rows(every, query)
        first = int(query["from"]) if query.get("from", "").isdecimal() else 0
        page = matching[first : first + MOST_ROWS]
        return JSONResponse(
            {
                "of": len(every),
                "total": len(matching),
                "rows": [row.columns for row in page],
                "command": self._command(words),
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
        return Response(self._png(key, int(view), int(width)), media_type="image/png")

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
        renderers = page_renderers(loaded, self._child, self._checkpoint, floors)
        name = f"scene {key}, {shard.split}"
        return SceneHandlers(name=name, loaded=loaded, renderers=renderers, source=place)


THUMBNAIL_PX = 128
"""Width in pixels of thumbnails."""

_THUMBNAIL = PreviewSettings(resolution=THUMBNAIL_PX, spp=4)


class FolderHandlers(SceneListHandlers):
    """Handlers of a folder, and of its scenes that are open."""

    key = re.compile(r"\d{1,5}", re.ASCII)

    def __init__(self, root: Path, child: RenderChild, checkpoint: str | None) -> None:
        """List the files; render child and checkpoint are for the pages of the scenes."""
        super().__init__(child, checkpoint)
        self._root = root
        self._names, self._is_cut = scene_list(root)
        self._reader = SceneReader()
        self._reading = threading.Lock()
        self._last: tuple[int, LoadedScene] | None = None
        self._png = functools.lru_cache(MOST_THUMBNAILS)(self._small_png)

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""
        return {
            **super().routes(),
            "GET api/folder": self._facts,
            "GET api/about/": self._about,
        }

    def close(self) -> None:
        """Stop reading and rendering."""
        super().close()
        self._reader.close()

    def _facts(self, _: Request) -> Response:
        suffixes = sorted({Path(name).suffix.lower() for name in self._names})
        return JSONResponse(
            {
                "name": self._root.resolve().name,
                "files": list(self._names),
                "forms": suffixes,
                "is_cut": self._is_cut,
            }
        )

    def _about(self, request: Request) -> Response:
        loaded = self._load(self._row(request.path.removeprefix("api/about/")))
        scene = loaded.scene
        return JSONResponse(
            {
                "triangles": scene.num_triangles,
                "lights": num_lights(scene),
                "textures": len(scene.textures),
                "views": scene.num_views,
                "notes": len(loaded.notes),
            }
        )

    def _thumbnail(self, request: Request) -> Response:
        row = self._row(request.path.removeprefix("api/thumbnail/"))
        return Response(self._png(row), media_type="image/png")

    def _small_png(self, number: int) -> bytes:
        loaded = self._load(number)
        if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
            return thumbnail_png(loaded.radiance_rgb[0], THUMBNAIL_PX)
        tracer = PathTracer(self._child, _THUMBNAIL)
        traced = tracer.load(loaded.scene, self._names[number])
        image = traced.render(Camera.of_scene(loaded.scene, 0))
        return thumbnail_png(image.radiance_rgb, THUMBNAIL_PX)

    def _row(self, key: str) -> int:
        if not self.key.fullmatch(key) or int(key) >= len(self._names):
            raise NotFound("the folder has no such file.")
        return int(key)

    def _load(self, number: int) -> LoadedScene:
        """Return a scene; the last one is kept, since the page requests it several times."""
        with self._reading:
            if self._last is None or self._last[0] != number:
                source = scene_source(str(self._root / self._names[number]))
                self._last = (number, self._reader.load(source, pictures=True))
            return self._last[1]

    def _open_scene(self, key: str) -> SceneHandlers:
        number = self._row(key)
        name = self._names[number]
        loaded = self._load(number)
        renderers = page_renderers(loaded, self._child, self._checkpoint)
        place = str(self._root / name)
        return SceneHandlers(name=name, loaded=loaded, renderers=renderers, source=place)
