"""A page that is there before what it shows: its questions wait until the source is open."""

from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

from infra.run_record import is_run, tensorboard_command
from infra.viewer.server import Answer, Question, Route, routed
from infra.viewer.static_files import static_routes
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError

_KEY = "::"
"""Between the file of many scenes and the key of one."""


class PageRoom(Protocol):
    """What a page asks about."""

    def gets(self) -> dict[str, Route]:
        """Return what is asked by GET."""

    def posts(self) -> dict[str, Route]:
        """Return what is asked by POST."""

    def close(self) -> None:
        """End what is being read or made."""


def page_of(source: str) -> str:
    """Return the name of the page that shows a source; TrilightError where nothing is there."""
    if "://" in source:
        return "dataset.html"
    path = Path(source)
    if path.is_dir():
        if is_run(path):
            raise TrilightError(
                f"{source}: the folder of a training run; expected scenes or a dataset. Its curves "
                f"and pictures: `{tensorboard_command(path)}`."
            )
        if DatasetFolder(path).manifest.exists():
            return "dataset.html"
        from infra.viewer.scene_list import scene_list  # slow: formats

        scene_list(path)
        return "folder.html"
    if not Path(source.rpartition(_KEY)[0] or source).exists():
        raise TrilightError(
            f"{source}: no such file; expected a scene, a folder of scenes, or a dataset."
        )
    return "scene.html"


class LaterRoom:
    """The routes of a room that is being opened."""

    def __init__(self, page: str) -> None:
        """Take the page that asks; `opened` gives the room once it is set."""
        self.opened = Future[PageRoom]()
        self.gets: dict[str, Route] = {
            **static_routes(page), "api/": self._get, "scene/": self._get,
        }  # fmt: skip
        self.posts: dict[str, Route] = {"api/": self._post, "scene/": self._post}

    def _get(self, question: Question) -> Answer:
        return routed(self.opened.result().gets(), question)

    def _post(self, question: Question) -> Answer:
        return routed(self.opened.result().posts(), question)
