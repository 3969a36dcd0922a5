"""Rendered samples to measure on: scenes of a build as its own render child makes them."""

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path

from infra.bench.harness import Options
from infra.bench.render_child import asked_child
from pipeline.flows.make_scene import MAX_ATTEMPTS, attempt_scene
from pipeline.flows.settings import BuildSettings
from storage.errors import TrilightError
from storage.sample import Sample


def rendered_samples(
    build: BuildSettings, options: Options, count: int, done: Callable[[], None]
) -> list[Sample]:
    """Return the first scenes of a build, rendered; `done` is called after each."""
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.closing(asked_child(Path(folder), build, options)) as child:
            samples = []
            for scene_index in range(count):
                samples.append(child.call(first_sample, scene_index))
                done()
    return samples


def first_sample(scene_index: int) -> Sample:
    """Return the sample of a training scene's first attempt that passes; runs in a render child.

    Raises:
        TrilightError: none does.
    """
    for attempt in range(MAX_ATTEMPTS):
        sample = attempt_scene("train", scene_index, attempt).sample
        if sample is not None:
            return sample
    raise TrilightError(f"scene {scene_index}: rejected {MAX_ATTEMPTS} times; choose others.")
