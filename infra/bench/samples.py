"""Rendered samples to measure on: scenes of a build as its own render child makes them."""

import contextlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from infra.bench.harness import Options
from pipeline.flows.accept_objects import accept_objects
from pipeline.flows.environment import environment
from pipeline.flows.make_scene import MAX_ATTEMPTS, SceneSource, attempt_scene, set_up_child
from pipeline.flows.publication import begin
from pipeline.flows.settings import BuildSettings
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.renders.variant import choose_variant
from storage.layout import DatasetFolder
from storage.sample import Sample

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=10_000)


def rendered_samples(
    build: BuildSettings, options: Options, count: int, done: Callable[[], None]
) -> list[Sample]:
    """Return the first scenes of a build, rendered; `done` is called after each."""
    with tempfile.TemporaryDirectory() as folder:
        child = _child(DatasetFolder(Path(folder)), build, options)
        with contextlib.closing(child):
            samples = []
            for scene_index in range(count):
                samples.append(_first(child, scene_index))
                done()
    return samples


def _child(folder: DatasetFolder, build: BuildSettings, options: Options) -> IsolatedChild:
    variant, threads = choose_variant(), os.cpu_count() or 1
    publication = begin(folder, build, environment(variant), 1, accept_environment=False)
    accepted = accept_objects(options.objects[0], None, build, publication, workers=threads)
    source = SceneSource(settings=build, variant=variant, threads=threads, objects=accepted.objects)
    return IsolatedChild(limits=_LIMITS, setup=set_up_child, setup_args=(source,))


def _first(child: IsolatedChild, scene_index: int) -> Sample:
    """Return the sample of the first attempt that passes."""
    attempts = (
        child.call(attempt_scene, "train", scene_index, attempt).sample
        for attempt in range(MAX_ATTEMPTS)
    )
    return next(sample for sample in attempts if sample)
