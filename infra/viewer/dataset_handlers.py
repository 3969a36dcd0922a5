"""Request handlers of a dataset's page: rows, thumbnails, and any scene as a page below it."""

import dataclasses
import functools
import re
from pathlib import Path

from infra.render.path_tracer import RenderChild
from infra.viewer.dataset_index import DatasetIndex, SceneFilter, SceneRow, filter_of
from infra.viewer.scene_handlers import (
    MOST_THUMBNAILS,
    OpenScenes,
    SceneHandlers,
    handlers_of_scene,
    thumbnail_png,
)
from infra.viewer.server import NotFound, Request, Response, Routes, json_response
from pipeline.exchange.formats import LoadedScene
from storage.dataset.dataset import Dataset, LocalFiles, reading
from storage.dataset.shard import read_member, scan_samples
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.remote.safe_url import safe_url

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
        if not isinstance(self._dataset.files, LocalFiles):
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
            self._dataset.files.open(shard, checked=False) as stream,
            reading(self._dataset.display_name, shard.name),
        ):
            samples = scan_samples(stream, shard.name)
            members = next(members for key, members in samples if key == row.key)
            radiance_rgb = decode_exr(read_member(stream, members[f"{view}.exr"]))
        return thumbnail_png(radiance_rgb, width)

    def _open_scene(self, key: str) -> SceneHandlers:
        row = self.index.row(key)
        shard = self._dataset.manifest.shards[row.shard]
        (sample,) = self._dataset.read_samples(shard, [key])
        floors = [view.noise_floor_db for view in sample.views]
        loaded = LoadedScene(scene=sample.scene, notes=(), radiance_rgb=sample.radiance_rgb)
        is_here = isinstance(self._dataset.files, LocalFiles)
        place = f"{Path(self._source) / shard.name}::{key}" if is_here else ""
        name = f"scene {key}, {row.split}"
        return handlers_of_scene(name, loaded, place, self._child, self._checkpoint, floors)
