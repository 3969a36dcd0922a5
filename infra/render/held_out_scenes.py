"""Held-out scenes, which no network was trained on, composed in a render child.

`builtin:benchmark-v1` shares no object with any other source, and no preset for training uses it.
Previews and methods are evaluated and timed on these scenes.
"""

import dataclasses
from pathlib import Path

from pipeline.generation.dataset_writer import begin_or_resume_dataset
from pipeline.generation.freeze_objects import ObjectLock
from pipeline.generation.prepare_isolated import asset_store
from pipeline.generation.scene_worker import SceneWorker
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.presets.settings import DatasetSettings
from pipeline.presets.training import smoke
from pipeline.renders.mitsuba_variant import Variant, choose_variant, environment
from pipeline.shards.pack_shards import PublishedShards
from storage.dataset.layout import DatasetFolder
from storage.dataset.splits import JUDGED_SPLIT
from storage.machine import available_cores
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides

TRIANGLES = 768
"""Maximum number of triangles of a scene, as in the training data of the built-in networks."""

_SEED = 20_261_122
"""Seed of the scenes; no dataset preset and no run uses it."""

_LEAST_LEVEL = 24
_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=4 * 3600, calls_per_child=10_000)


def composing_child(
    settings: DatasetSettings,
    objects: str,
    folder: Path,
    threads: int | None = None,
    variant: Variant | None = None,
) -> IsolatedChild:
    """Return a child that composes and renders the scenes of a preset; the caller closes it.

    Args:
        folder: empty folder for the record of the objects.
        threads: CPU threads of Mitsuba and the denoiser; None for all cores.
        variant: Mitsuba variant; None for that of the CPU, or of TRILIGHT_VARIANT.
    """
    variant = variant or choose_variant()
    shards = PublishedShards(DatasetFolder(folder))
    publication = begin_or_resume_dataset(shards, settings, environment(variant), 1)
    lock = ObjectLock(source=objects, licence=None, settings=settings, writer=publication)
    origin = lock.accept().origin
    arguments = (settings, origin, asset_store(), variant, threads or available_cores())
    limits = dataclasses.replace(_LIMITS, memory_bytes=variant.address_space(_LIMITS.memory_bytes))
    return IsolatedChild(limits=limits, factory=SceneWorker, args=arguments)


def held_out_settings() -> DatasetSettings:
    """Return the preset `smoke` with at most TRIANGLES triangles a scene and coarser objects.

    All objects belong to the evaluation split, as those of `builtin:benchmark-v1` do.
    """
    settings = apply_overrides(smoke(), {"splits.one_split": True})
    most = settings.scenes.max_triangles
    budgets = [max(_LEAST_LEVEL, b * TRIANGLES // most) for b in settings.assets.budgets]
    levels = sorted(set(budgets), reverse=True)
    return apply_overrides(settings, {"scenes.max_triangles": TRIANGLES, "assets.budgets": levels})


def held_out_scene(child: IsolatedChild, index: int) -> Scene:
    """Return a scene of `held_out_settings` with one camera, composed in a child of that preset.

    Raises:
        Rejected: every attempt at it was rejected.
    """
    settings = dataclasses.replace(held_out_settings().scenes, num_views=1)
    return child.call_method(SceneWorker.compose_first, settings, index, _SEED, JUDGED_SPLIT)
