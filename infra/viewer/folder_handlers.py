"""Request handlers of the page of a folder: the list of scene files, their facts and their pages.

A file is read when its row becomes visible, by one child with limits; thumbnails have few samples.
"""

import functools
import re
import threading
from pathlib import Path

from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import FixedSamples
from infra.viewer.open_source import scene_list
from infra.viewer.scene_handlers import (
    MOST_THUMBNAILS,
    SceneHandlers,
    SceneListHandlers,
    handlers_of_scene,
    thumbnail_png,
)
from infra.viewer.server import NotFound, Request, Response, Routes, json_response
from pipeline.exchange.formats import LoadedScene
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from storage.records.lights import num_lights
from storage.renderer import Camera

THUMBNAIL_PX = 128
"""Width in pixels of thumbnails."""

_THUMBNAIL = FixedSamples(spp=4, denoiser="fast")


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
        return json_response(
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
        return json_response(
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
        return Response(body=self._png(row), kind="image/png")

    def _small_png(self, number: int) -> bytes:
        loaded = self._load(number)
        if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
            return thumbnail_png(loaded.radiance_rgb[0], THUMBNAIL_PX)
        tracer = PathTracer(self._child, _THUMBNAIL, THUMBNAIL_PX)
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
        place = str(self._root / name)
        return handlers_of_scene(name, loaded, place, self._child, self._checkpoint)
