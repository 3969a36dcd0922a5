"""Rendered samples to measure on: scenes of a build as its own render child makes them."""

import contextlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from infra.bench.harness import Options
from infra.bench.render_child import render_child
from pipeline.flows.make_scene import MAX_ATTEMPTS, attempt_scene
from pipeline.flows.settings import BuildSettings
from pipeline.isolation import IsolatedChild
from storage.sample import Sample


def rendered_samples(
    build: BuildSettings, options: Options, count: int, done: Callable[[], None]
) -> list[Sample]:
    """Return the first scenes of a build, rendered; `done` is called after each."""
    with tempfile.TemporaryDirectory() as folder:
        child = render_child(
            Path(folder), build, objects=options.objects[0], threads=os.cpu_count() or 1
        )
        with contextlib.closing(child):
            samples = []
            for scene_index in range(count):
                samples.append(_first(child, scene_index))
                done()
    return samples


def _first(child: IsolatedChild, scene_index: int) -> Sample:
    """Return the sample of the first attempt that passes."""
    attempts = (
        child.call(attempt_scene, "train", scene_index, attempt).sample
        for attempt in range(MAX_ATTEMPTS)
    )
    return next(sample for sample in attempts if sample)
