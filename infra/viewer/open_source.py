"""Opens the source of `trilight view`: a scene, a folder of scenes, or a dataset."""

from pathlib import Path

from infra.render.path_tracer import RenderChild
from infra.viewer.dataset_handlers import DatasetHandlers
from infra.viewer.deferred_handlers import PageHandlers, page_of
from infra.viewer.folder_handlers import FolderHandlers
from infra.viewer.scene_handlers import handlers_of_scene
from infra.viewer.scene_list import scene_list
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.renders.mitsuba_variant import choose_variant
from storage.dataset.dataset import open_dataset


def open_handlers(source: str, *, checkpoint: str | None, threads: int | None) -> PageHandlers:
    """Open a source, and return the handlers of its page.

    Args:
        source: a scene as `trilight render` takes it, a folder of such files, or a dataset
            (folder or URL).
        checkpoint: network to show in addition to the built-in ones.
        threads: CPU threads of the path tracer; None for one for each core.

    Raises:
        TrilightError: the source is unusable.
    """
    page = page_of(source)
    if page == "folder.html":
        return FolderHandlers(scene_list(Path(source)), _child(threads), checkpoint)
    if page == "dataset.html":
        return DatasetHandlers(open_dataset(source), source, _child(threads), checkpoint)
    file = scene_source(source)
    with SceneReader() as reader:
        loaded = reader.load(file, pictures=True)
    child = _child(threads)
    room = handlers_of_scene(file.name, loaded, source, child, checkpoint)
    room.child = child
    return room


def _child(threads: int | None) -> RenderChild:
    return RenderChild(choose_variant("auto"), threads)
