"""Pages of single scenes below the page of many: the last few stay open."""

import dataclasses
import re
import threading
from collections import OrderedDict
from collections.abc import Callable

from infra.viewer.scene_room import SceneRoom
from infra.viewer.server import Answer, NotThere, Question, routed
from infra.viewer.static_files import static_routes

MOST_OPEN = 3
"""Scenes whose pages are open."""

_BELOW = re.compile(r"scene/([^/]+)/(.*)", re.DOTALL)


class OpenRooms:
    """Scenes by their keys, each at `scene/KEY/`."""

    def __init__(self, key: re.Pattern[str], opened: Callable[[str], SceneRoom]) -> None:
        """Take what a key looks like, and what opens one; it may raise TrilightError."""
        self._key = key
        self._opened = opened
        self._opening = threading.Lock()
        self._open = OrderedDict[str, SceneRoom]()

    def get(self, question: Question) -> Answer:
        """Answer a GET."""
        room, below = self._room(question)
        return routed({**static_routes("scene.html"), **room.gets()}, below)

    def post(self, question: Question) -> Answer:
        """Answer a POST."""
        room, below = self._room(question)
        return routed(room.posts(), below)

    def close(self) -> None:
        """End what is being made, and wait for it."""
        for room in self._open.values():
            room.close()

    def _room(self, question: Question) -> tuple[SceneRoom, Question]:
        found = _BELOW.fullmatch(question.path)
        if found is None or not self._key.fullmatch(found[1]):
            raise NotThere("there is no such scene.")
        key = found[1]
        with self._opening:
            room = self._open.pop(key, None) or self._opened(key)
            self._open[key] = room
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].easel.close()
        return room, dataclasses.replace(question, path=found[2])
