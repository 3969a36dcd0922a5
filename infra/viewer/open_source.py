"""Opens what SRC of `trilight view` means: one scene, a dataset, or the folder of a run."""

import os
from pathlib import Path

from infra.viewer.dataset_room import DatasetRoom
from infra.viewer.later import PageRoom, page_of
from infra.viewer.painters import TargetPainter, painters_of
from infra.viewer.run_room import RunRoom
from infra.viewer.scene_room import SceneRoom
from pipeline.exchange.formats import SceneSource
from pipeline.exchange.open_scene import scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.making.progressive_tracer import ProgressiveTracer
from pipeline.renders.variant import choose_variant
from storage.dataset.dataset import open_dataset


def opened_room(source: str, *, checkpoint: str | None, threads: int | None) -> PageRoom:
    """Open a source.

    Args:
        source: a scene as `trilight render` takes it, a dataset (folder or URL), or a run's folder.
        checkpoint: a network to show beside the built-in ones.
        threads: of the tracer; None for one for each core.

    Raises:
        TrilightError: the source is unusable.
    """
    page = page_of(source)
    if page == "run.html":
        return RunRoom(Path(source))
    found = scene_source(source) if page == "scene.html" else open_dataset(source)
    tracer = ProgressiveTracer(variant=choose_variant(), threads=threads or os.cpu_count() or 1)
    if isinstance(found, SceneSource):
        return _scene_room(found, tracer, checkpoint)
    return DatasetRoom(found, source, tracer, checkpoint)


def _scene_room(
    source: SceneSource, tracer: ProgressiveTracer, checkpoint: str | None
) -> SceneRoom:
    with SceneReader() as reader:
        loaded = reader.load(source, pictures=True)
    target = None
    if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
        target = TargetPainter(loaded.radiance_rgb, ())
    return SceneRoom(
        name=source.name,
        scene=loaded.scene,
        notes=loaded.notes,
        painters=painters_of(tracer, target, checkpoint),
        target_px=None if target is None else target.width_px,
        tracer=tracer,
    )
