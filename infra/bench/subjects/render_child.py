"""A render child to measure with: a build's settings, and its objects at hand."""

import dataclasses
import os
from pathlib import Path

from infra.bench.asked import Asked
from pipeline.builds.settings import BuildSettings
from pipeline.builds.training import smoke
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.making.environment import environment
from pipeline.making.make_scene import SceneRecipe, set_up_child
from pipeline.making.pipeline import accept_objects
from pipeline.making.publication import begin
from pipeline.renders.variant import choose_variant
from storage.dataset.layout import DatasetFolder

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=4 * 3600, calls_per_child=10_000)


def render_child(
    folder: Path, build: BuildSettings, *, objects: str, threads: int
) -> IsolatedChild:
    """Return a child that can compose the scenes of a build and render them.

    Args:
        folder: an empty one, for the record of its objects.
        build: the settings.
        objects: source of the objects.
        threads: of Mitsuba and the denoiser.
    """
    variant = choose_variant()
    here = environment(variant)
    publication = begin(DatasetFolder(folder), build, here, 1, accept_environment=False)
    accepted = accept_objects(objects, None, build, publication, workers=threads)
    source = SceneRecipe(settings=build, variant=variant, threads=threads, objects=accepted.objects)
    return IsolatedChild(limits=_LIMITS, setup=set_up_child, setup_args=(source,))


def asked_child(folder: Path, build: BuildSettings, asked: Asked) -> IsolatedChild:
    """Return a child on all cores for a build of the objects that the user names.

    Of several sources the first counts.
    """
    allowed = dataclasses.replace(build, allowed_licences=asked.allowed_licences)
    threads = os.cpu_count() or 1
    return render_child(folder, allowed, objects=asked.objects[0], threads=threads)


def smoke_child(folder: Path, *, threads: int) -> IsolatedChild:
    """Return a child for the sampled scenes: the build `smoke`, of built-in objects."""
    return render_child(folder, smoke(), objects="builtin:", threads=threads)
