"""Opens what SRC of `trilight view` means: one scene or many, or a dataset."""

import os
from pathlib import Path

from infra.viewer.dataset_room import DatasetRoom
from infra.viewer.folder_room import FolderRoom, scene_room
from infra.viewer.later import PageRoom, page_of
from infra.viewer.scene_list import scene_list
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.making.progressive_tracer import ProgressiveTracer
from pipeline.renders.variant import choose_variant
from storage.dataset.dataset import open_dataset


def opened_room(source: str, *, checkpoint: str | None, threads: int | None) -> PageRoom:
    """Open a source.

    Args:
        source: a scene as `trilight render` takes it, a folder of such files, or a dataset
            (folder or URL).
        checkpoint: a network to show beside the built-in ones.
        threads: of the tracer; None for one for each core.

    Raises:
        TrilightError: the source is unusable.
    """
    page = page_of(source)
    if page == "folder.html":
        return FolderRoom(scene_list(Path(source)), _tracer(threads), checkpoint)
    if page == "dataset.html":
        return DatasetRoom(open_dataset(source), source, _tracer(threads), checkpoint)
    found = scene_source(source)
    with SceneReader() as reader:
        loaded = reader.load(found, pictures=True)
    tracer = _tracer(threads)
    room = scene_room(found.name, loaded, tracer, checkpoint, source)
    room.tracer = tracer
    return room


def _tracer(threads: int | None) -> ProgressiveTracer:
    return ProgressiveTracer(variant=choose_variant(), threads=threads or os.cpu_count() or 1)
