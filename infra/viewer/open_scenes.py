"""Pages of single scenes below the page of many; the most recent ones stay open."""

import dataclasses
import re
import threading
from collections import OrderedDict
from collections.abc import Callable

from infra.viewer.scene_handlers import SceneHandlers
from infra.viewer.server import NotFound, Request, Response, dispatch
from infra.viewer.static_files import static_routes

MOST_OPEN = 3
"""Maximum number of scenes whose pages stay open."""

_BELOW = re.compile(r"scene/([^/]+)/(.*)", re.DOTALL)


class OpenScenes:
    """Handlers of the most recent scenes by key, each at `scene/KEY/`."""

    def __init__(self, key: re.Pattern[str], open_scene: Callable[[str], SceneHandlers]) -> None:
        """Store the pattern of keys, and the function that opens a scene by its key."""
        self._key = key
        self._open_scene = open_scene
        self._opening = threading.Lock()
        self._open = OrderedDict[str, SceneHandlers]()

    def get(self, request: Request) -> Response:
        """Respond to a GET request."""
        room, below = self._scene_handlers(request)
        return dispatch({**static_routes("scene.html"), **room.gets()}, below)

    def post(self, request: Request) -> Response:
        """Respond to a POST request."""
        room, below = self._scene_handlers(request)
        return dispatch(room.posts(), below)

    def close(self) -> None:
        """Stop rendering, and wait for its end."""
        for room in self._open.values():
            room.close()

    def _scene_handlers(self, request: Request) -> tuple[SceneHandlers, Request]:
        match = _BELOW.fullmatch(request.path)
        if match is None or not self._key.fullmatch(match[1]):
            raise NotFound("there is no such scene.")
        key = match[1]
        with self._opening:
            room = self._open.pop(key, None) or self._open_scene(key)
            self._open[key] = room
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].queue.close()
        return room, dataclasses.replace(request, path=match[2])
