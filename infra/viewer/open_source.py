"""Opens the source of `trilight view`; its page is served before, and its requests wait."""

import os
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

from starlette.responses import Response

from infra.run_record import is_run, tensorboard_command
from infra.viewer.server import Request, Routes, dispatch, static_routes
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError

_KEY = "::"
"""Separator between the file of many scenes and the key of one."""

MOST_FILES = 5000
"""Maximum number of listed files; a larger folder is cut."""


class PageHandlers(Protocol):
    """Request handlers of a page."""

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""

    def close(self) -> None:
        """Stop reading and rendering."""


def deferred_routes(page: str, opened: Future[PageHandlers]) -> Routes:
    """Return the routes of a page whose other requests wait until its source is opened."""

    def respond(request: Request) -> Response:
        return dispatch(opened.result().routes(), request)

    waiting = ("GET api/", "GET scene/", "POST api/", "POST scene/")
    return {**static_routes(page), **dict.fromkeys(waiting, respond)}


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
        scene_list(path)
        return "folder.html"
    if not Path(source.rpartition(_KEY)[0] or source).exists():
        raise TrilightError(
            f"{source}: no such file; expected a scene, a folder of scenes, or a dataset."
        )
    return "scene.html"


def scene_list(root: Path) -> tuple[Sequence[str], bool]:
    """Return the files with a scene's suffix in a folder and its subfolders, and whether it is cut.

    Paths are relative to the folder, with slashes, and sorted. A list that is cut leaves out some.
    Hidden folders and links to folders are left out.

    Raises:
        TrilightError: there is no such file.
    """
    from pipeline.exchange.formats import readable_suffixes  # slow

    suffixes = frozenset(readable_suffixes())
    names = list[str]()
    for folder, below, files in os.walk(root):
        below[:] = sorted(name for name in below if not name.startswith("."))
        paths = (Path(folder, name) for name in files if not name.startswith("."))
        scenes = (path for path in paths if path.suffix.lower() in suffixes)
        names += [path.relative_to(root).as_posix() for path in scenes]
        if len(names) > MOST_FILES:
            break
    names.sort()
    if not names:
        raise TrilightError(
            f"{root}: no dataset, and holds no scene; expected a folder that `trilight generate` "
            f"wrote, or files {' '.join(readable_suffixes())} in it."
        )
    return names[:MOST_FILES], len(names) > MOST_FILES


def open_handlers(source: str, *, checkpoint: str | None, threads: int | None) -> PageHandlers:
    """Open a source, and return the handlers of its page; imports formats and renderers.

    Args:
        source: a scene as `trilight render` takes it, a folder of such files, or a dataset
            (folder or URL).
        checkpoint: network to show in addition to the built-in ones.
        threads: CPU threads of the path tracer; None for one for each core.

    Raises:
        TrilightError: the source is unusable.
    """
    from infra.render.path_tracer import RenderChild
    from infra.viewer.list_handlers import DatasetHandlers, FolderHandlers
    from infra.viewer.page_renderers import page_renderers
    from infra.viewer.scene_handlers import SceneHandlers
    from pipeline.exchange.reader import SceneReader, scene_source
    from pipeline.renders.mitsuba_variant import choose_variant
    from storage.dataset.dataset import open_dataset

    page = page_of(source)
    child = RenderChild(choose_variant("auto"), threads)
    if page == "folder.html":
        return FolderHandlers(Path(source), child, checkpoint)
    if page == "dataset.html":
        return DatasetHandlers(open_dataset(source), source, child, checkpoint)
    file = scene_source(source)
    with SceneReader() as reader:
        loaded = reader.load(file, pictures=True)
    return SceneHandlers(
        name=file.name,
        loaded=loaded,
        renderers=page_renderers(loaded, child, checkpoint),
        source=source,
        child=child,
    )
