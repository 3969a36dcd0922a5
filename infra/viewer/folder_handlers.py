"""Request handlers of the page of a folder: the list of scene files, their facts and their pages.

A file is read when its row becomes visible, by one child with limits; thumbnails have few samples.
"""

import re
import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import FixedSamples
from infra.viewer.open_scenes import OpenScenes
from infra.viewer.page_renderers import StoredPictures, page_renderers
from infra.viewer.scene_handlers import SceneHandlers
from infra.viewer.scene_list import SceneList
from infra.viewer.server import NotFound, Request, Response, Route, json_response
from pipeline.documents.png import encode_png
from pipeline.documents.scene_page import preview
from pipeline.exchange.formats import LoadedScene
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from storage.conventions import preview_gain
from storage.records.lights import num_lights
from storage.renderer import Camera

THUMBNAIL_PX = 128
"""Width in pixels of thumbnails."""

_THUMBNAIL = FixedSamples(spp=4, denoiser="fast")

_MOST_THUMBNAILS = 1000
_NUMBER = re.compile(r"\d{1,5}", re.ASCII)


class FolderHandlers:
    """Handlers of a folder, and of its scenes that are open."""

    def __init__(self, files: SceneList, child: RenderChild, checkpoint: str | None) -> None:
        """Store render child and checkpoint for the pages of the scenes; nothing is read yet."""
        self._files = files
        self._child = child
        self._checkpoint = checkpoint
        self._reader = SceneReader()
        self._reading = threading.Lock()
        self._last: tuple[int, LoadedScene] | None = None
        self._thumbnails = OrderedDict[int, bytes]()
        self._scenes = OpenScenes(_NUMBER, self._open_scene)

    def gets(self) -> dict[str, Route]:
        """Return the routes of GET requests."""
        return {
            "api/folder": self._facts,
            "api/about/": self._about,
            "api/thumbnail/": self._thumbnail,
            "scene/": self._scenes.get,
        }

    def posts(self) -> dict[str, Route]:
        """Return the routes of POST requests."""
        return {"scene/": self._scenes.post}

    def close(self) -> None:
        """Stop reading and rendering."""
        self._scenes.close()
        self._child.close()
        self._reader.close()

    def _facts(self, _: Request) -> Response:
        files = self._files
        suffixes = sorted({Path(name).suffix.lower() for name in files.names})
        return json_response(
            {
                "name": files.root.resolve().name,
                "files": list(files.names),
                "forms": suffixes,
                "is_cut": files.is_cut,
            }
        )

    def _about(self, request: Request) -> Response:
        loaded = self._load(self._number(request, "api/about/"))
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
        number = self._number(request, "api/thumbnail/")
        png = self._thumbnails.get(number)
        if png is None:
            radiance_rgb = self._small_picture(number, self._load(number))
            exposed = radiance_rgb * preview_gain(radiance_rgb)
            png = self._thumbnails[number] = encode_png(preview(exposed, THUMBNAIL_PX))
            while len(self._thumbnails) > _MOST_THUMBNAILS:
                self._thumbnails.popitem(last=False)
        return Response(body=png, kind="image/png")

    def _small_picture(self, number: int, loaded: LoadedScene) -> NDArray[np.float32]:
        if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
            return loaded.radiance_rgb[0]
        tracer = PathTracer(self._child, _THUMBNAIL, THUMBNAIL_PX)
        traced = tracer.load(loaded.scene, self._files.names[number])
        return traced.render(Camera.of_scene(loaded.scene, 0)).radiance_rgb

    def _number(self, request: Request, prefix: str) -> int:
        text = request.path.removeprefix(prefix)
        if not _NUMBER.fullmatch(text) or int(text) >= len(self._files.names):
            raise NotFound("the folder has no such file.")
        return int(text)

    def _load(self, number: int) -> LoadedScene:
        """Return a scene; the last one is kept, since the page requests it several times."""
        with self._reading:
            if self._last is None or self._last[0] != number:
                source = scene_source(str(self._files.root / self._files.names[number]))
                self._last = (number, self._reader.load(source, pictures=True))
            return self._last[1]

    def _open_scene(self, key: str) -> SceneHandlers:
        number = int(key)
        if number >= len(self._files.names):
            raise NotFound("the folder has no such file.")
        name = self._files.names[number]
        loaded = self._load(number)
        place = str(self._files.root / name)
        return handlers_of_scene(name, loaded, self._child, self._checkpoint, place)


def handlers_of_scene(
    name: str,
    loaded: LoadedScene,
    child: RenderChild,
    checkpoint: str | None,
    source: str,
) -> SceneHandlers:
    """Return the handlers of a loaded scene; they do not close the render child."""
    target = None
    if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
        target = StoredPictures(scene=loaded.scene, radiance_rgb=loaded.radiance_rgb)
    return SceneHandlers(
        name=name,
        scene=loaded.scene,
        notes=loaded.notes,
        renderers=page_renderers(child, target, checkpoint),
        target_px=None if target is None else target.resolution,
        source=source,
    )
