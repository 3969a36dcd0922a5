"""Registry of named builds: each is a function that returns the full settings of a dataset."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from pipeline.builds.judging import JUDGING_BUILDS
from pipeline.builds.renderformer import RENDERFORMER_BUILDS
from pipeline.builds.settings import BuildSettings, NamedBuild
from pipeline.builds.training import TRAINING_BUILDS
from pipeline.objects.generated import BENCHMARK
from pipeline.objects.generated import PREFIX as BUILTIN
from pipeline.renders.settings import NoiseTargets
from storage.aliases import OBJECTS, PRESETS, stored_name
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.registry import Registry
from storage.remote.safe_url import safe_url
from storage.settings.changes import changed

BUILDS: Registry[NamedBuild] = Registry(
    "build",
    NamedBuild,
    {**TRAINING_BUILDS, **RENDERFORMER_BUILDS, **JUDGING_BUILDS},
    decides=("data",),
    aliases=PRESETS,
)
"""Builds by the name that the command line takes."""


def typed_build(typed: str) -> str:
    """Return the name of a build that was typed on a command line; executes a user's file.

    For FILE.py:FUNCTION it registers the function's result: a NamedBuild, or BuildSettings, which
    get one cycle of shards by default. Names from a dataset or a form must not be passed, since the
    file is executed.

    Raises:
        TrilightError: as `Registry.resolve`, or the function returns something else.
    """
    return BUILDS.resolve(typed, _as_build)


def _as_build(returned: Any) -> NamedBuild:
    if isinstance(returned, BuildSettings):
        splits = returned.splits
        num_scenes = splits.shards_per_cycle * splits.scenes_per_shard
        return NamedBuild(settings=lambda: returned, num_scenes=num_scenes)
    if isinstance(returned, NamedBuild):
        return returned
    raise TrilightError(
        f"it returned a {type(returned).__name__}; expected BuildSettings or a NamedBuild."
    )


def named_build(
    name: str,
    *,
    seed: int | None = None,
    resolution: int | None = None,
    noise_targets: NoiseTargets | None = None,
    allow_licences: tuple[str, ...] = (),
    changes: Mapping[str, Any] | None = None,
) -> BuildSettings:
    """Return the settings of a build with the caller's changes.

    Args:
        name: one of BUILDS.
        seed, resolution: replace the build's value unless None.
        noise_targets: if one is set, they replace all of the build's targets.
        allow_licences: licences that are allowed in addition to the build's.
        changes: any other settings by dotted name, such as `scenes.lights.coloured_share`.

    Raises:
        TrilightError: the name is unknown, or values contradict each other.
    """
    build = BUILDS.find(name).settings()
    if not BUILDS.is_ours(name) and BUILDS.is_ours(build.build):
        raise TrilightError(
            f"build {name!r}: its settings say build={build.build!r}, which is one of Trilight's "
            f"own; expected another name, such as dataclasses.replace(..., "
            f"build='my-{build.build}')."
        )
    build = changed(build, option_changes(seed, resolution, noise_targets or NoiseTargets()))
    licences = tuple(sorted({*build.allowed_licences, *allow_licences}))
    return changed(dataclasses.replace(build, allowed_licences=licences), changes or {})


def option_changes(
    seed: int | None, resolution: int | None, noise_targets: NoiseTargets
) -> dict[str, Any]:
    """Return the settings that single options state, by dotted name; None states nothing."""
    stated = {"seed": seed, "renders.resolution": resolution}
    changes: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    return changes | {f"renders.{name}": db for name, db in noise_targets.overrides.items()}


def object_source(settings: BuildSettings, objects: str | None) -> str:
    """Return the source of the objects.

    Raises:
        TrilightError: the build is frozen with another source than the given one.
    """
    objects = objects and stored_name(objects, OBJECTS)
    if settings.source is None:
        # An evaluated network may have been trained on the built-in objects.
        return objects or (BENCHMARK if settings.splits.one_split else BUILTIN)
    if objects is not None and objects != settings.source:
        raise TrilightError(
            f"--objects is {safe_url(objects)!r}; expected {settings.source!r}, the "
            f"fixed source of {settings.build}. Omit --objects, or choose another build."
        )
    return settings.source


def frozen_note(build: str, statistics: Statistics) -> tuple[str, ...]:
    """Return a note that compares the scenes of a frozen set with the published digest."""
    named = BUILDS[build]
    if named.scene_digest is None or statistics.num_scenes != named.num_scenes:
        return ()
    if statistics.scene_digest == named.scene_digest:
        return (f"these are the published {named.num_scenes} scenes of {build}",)
    return (
        f"the scene digest is {statistics.scene_digest}; the published scenes of {build} have "
        f"{named.scene_digest}. These are other scenes, so figures cannot be compared: install "
        "the exact versions with make setup",
    )
