"""Page that is served before its source is open; its requests wait until then."""

from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

from infra.run_record import is_run, tensorboard_command
from infra.viewer.server import Request, Response, Route, dispatch, static_routes
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError

_KEY = "::"
"""Separator between the file of many scenes and the key of one."""


class PageHandlers(Protocol):
    """Request handlers of a page."""

    def gets(self) -> dict[str, Route]:
        """Return the routes of GET requests."""

    def posts(self) -> dict[str, Route]:
        """Return the routes of POST requests."""

    def close(self) -> None:
        """Stop reading and rendering."""


def page_of(source: str) -> str:
    """Return the name of the page of a source; raises TrilightError without such a source."""
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


class DeferredHandlers:
    """Routes that wait for the handlers of a source that is being opened."""

    def __init__(self, page: str) -> None:
        """Serve a page; its other requests wait for the result of `opened`."""
        self.opened = Future[PageHandlers]()
        self.gets: dict[str, Route] = {
            **static_routes(page), "api/": self._get, "scene/": self._get,
        }  # fmt: skip
        self.posts: dict[str, Route] = {"api/": self._post, "scene/": self._post}

    def _get(self, request: Request) -> Response:
        return dispatch(self.opened.result().gets(), request)

    def _post(self, request: Request) -> Response:
        return dispatch(self.opened.result().posts(), request)
