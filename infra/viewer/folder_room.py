"""What the page of a folder of scene files may ask: the list, what a file holds, and its page.

A file is read when it comes into sight, by one child with limits, and is shown by few samples.
"""

import re
import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.viewer.open_rooms import OpenRooms
from infra.viewer.painters import MOST_SPP, TargetPainter, painters_of
from infra.viewer.scene_list import SceneList
from infra.viewer.scene_room import SceneRoom
from infra.viewer.server import Answer, NotThere, Question, Route, json_answer
from pipeline.documents.png import encode_png
from pipeline.documents.scene_page import preview
from pipeline.exchange.formats import LoadedScene
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.making.progressive_tracer import ProgressiveTracer
from pipeline.renders.results import GrowingPicture, Sampling
from pipeline.renders.settings import one_picture
from storage.conventions import preview_gain
from storage.records.lights import num_lights

THUMBNAIL_PX = 128
THUMBNAIL_SPP = 4
"""Width and samples a pixel of the small pictures."""

_MOST_THUMBNAILS = 1000
_NUMBER = re.compile(r"\d{1,5}", re.ASCII)


class FolderRoom:
    """A folder, and the scenes of it that are open."""

    def __init__(self, found: SceneList, tracer: ProgressiveTracer, checkpoint: str | None) -> None:
        """Read nothing yet; tracer and checkpoint are for the pages of its scenes."""
        self._found = found
        self._tracer = tracer
        self._checkpoint = checkpoint
        self._reader = SceneReader()
        self._reading = threading.Lock()
        self._last: tuple[int, LoadedScene] | None = None
        self._thumbnails = OrderedDict[int, bytes]()
        self._open = OpenRooms(_NUMBER, self._opened)

    def gets(self) -> dict[str, Route]:
        """Return what is asked by GET."""
        return {
            "api/folder": self._facts,
            "api/about/": self._about,
            "api/thumbnail/": self._thumbnail,
            "scene/": self._open.get,
        }

    def posts(self) -> dict[str, Route]:
        """Return what is asked by POST."""
        return {"scene/": self._open.post}

    def close(self) -> None:
        """End what is being read or made."""
        self._open.close()
        self._tracer.close()
        self._reader.close()

    def _facts(self, _: Question) -> Answer:
        found = self._found
        suffixes = sorted({Path(name).suffix.lower() for name in found.names})
        return json_answer(
            {
                "name": found.root.resolve().name,
                "files": list(found.names),
                "forms": suffixes,
                "is_cut": found.is_cut,
            }
        )

    def _about(self, question: Question) -> Answer:
        loaded = self._loaded(self._number(question, "api/about/"))
        scene = loaded.scene
        return json_answer(
            {
                "triangles": scene.num_triangles,
                "lights": num_lights(scene),
                "textures": len(scene.textures),
                "views": scene.num_views,
                "notes": len(loaded.notes),
            }
        )

    def _thumbnail(self, question: Question) -> Answer:
        number = self._number(question, "api/thumbnail/")
        png = self._thumbnails.get(number)
        if png is None:
            radiance_rgb = self._small_picture(number, self._loaded(number))
            exposed = radiance_rgb * preview_gain(radiance_rgb)
            png = self._thumbnails[number] = encode_png(preview(exposed, THUMBNAIL_PX))
            while len(self._thumbnails) > _MOST_THUMBNAILS:
                self._thumbnails.popitem(last=False)
        return Answer(body=png, kind="image/png")

    def _small_picture(self, number: int, loaded: LoadedScene) -> NDArray[np.float32]:
        if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
            return loaded.radiance_rgb[0]
        steps = list[Sampling]()
        scene = loaded.scene
        self._tracer.paint(
            scene,
            ("thumbnail", number),
            (scene.c2w[0], float(scene.fov_deg[0])),
            one_picture(resolution=THUMBNAIL_PX, max_spp=MOST_SPP),
            steps.append,
            preview_spp=THUMBNAIL_SPP,
        )
        last = steps[-1]
        assert isinstance(last, GrowingPicture)
        return last.radiance_rgb

    def _number(self, question: Question, prefix: str) -> int:
        text = question.path.removeprefix(prefix)
        if not _NUMBER.fullmatch(text) or int(text) >= len(self._found.names):
            raise NotThere("the folder has no such file.")
        return int(text)

    def _loaded(self, number: int) -> LoadedScene:
        """Return a scene; the last one is kept, as its facts, picture and page are asked for."""
        with self._reading:
            if self._last is None or self._last[0] != number:
                source = scene_source(str(self._found.root / self._found.names[number]))
                self._last = (number, self._reader.load(source, pictures=True))
            return self._last[1]

    def _opened(self, key: str) -> SceneRoom:
        number = int(key)
        if number >= len(self._found.names):
            raise NotThere("the folder has no such file.")
        name = self._found.names[number]
        loaded = self._loaded(number)
        place = str(self._found.root / name)
        return scene_room(name, loaded, self._tracer, self._checkpoint, place)


def scene_room(
    name: str,
    loaded: LoadedScene,
    tracer: ProgressiveTracer,
    checkpoint: str | None,
    source: str,
) -> SceneRoom:
    """Return the room of a scene that was read from a file; it leaves the tracer to its owner."""
    target = None
    if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
        target = TargetPainter(loaded.radiance_rgb, ())
    return SceneRoom(
        name=name,
        scene=loaded.scene,
        notes=loaded.notes,
        painters=painters_of(tracer, target, checkpoint),
        target_px=None if target is None else target.width_px,
        source=source,
    )
