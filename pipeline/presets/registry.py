"""Registry of dataset presets: each is a function that returns the full settings of a dataset."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from pipeline.presets.frozen_v1 import PRESETS_FOR_JUDGING, RENDERFORMER_PRESETS
from pipeline.presets.settings import DatasetPreset, DatasetSettings
from pipeline.presets.training import PRESETS_FOR_TRAINING
from pipeline.renders.settings import Targets, target_overrides
from storage.aliases import PRESET_ALIASES
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.extensions import mistakes_of_entry
from storage.registry import Registry
from storage.settings.overrides import apply_overrides

DATASET_PRESETS: Registry[DatasetPreset] = Registry(
    "dataset preset",
    DatasetPreset,
    {**PRESETS_FOR_TRAINING, **RENDERFORMER_PRESETS, **PRESETS_FOR_JUDGING},
    decides=("data",),
    aliases=PRESET_ALIASES,
)
"""Dataset presets by the name that the command line takes."""


def resolve_dataset_preset(typed: str) -> str:
    """Return the name of a dataset preset that was typed on a command line; executes a user's file.

    For FILE.py:FUNCTION it registers the function's result: a DatasetPreset, or DatasetSettings,
    which get one cycle of shards by default. Names from a dataset or a form must not be passed,
    since the file is executed.

    Raises:
        TrilightError: as `Registry.resolve`, or the function returns something else.
    """
    return DATASET_PRESETS.resolve(typed, _as_preset)


def _as_preset(returned: Any) -> DatasetPreset:
    if isinstance(returned, DatasetSettings):
        splits = returned.splits
        num_scenes = splits.shards_per_cycle * splits.scenes_per_shard
        return DatasetPreset(settings=lambda: returned, num_scenes=num_scenes)
    if isinstance(returned, DatasetPreset):
        return returned
    raise TrilightError(
        f"it returned a {type(returned).__name__}; expected DatasetSettings or a DatasetPreset."
    )


def preset_settings(
    name: str,
    *,
    seed: int | None = None,
    resolution: int | None = None,
    noise_targets: Targets | None = None,
    allow_licences: tuple[str, ...] = (),
    changes: Mapping[str, Any] | None = None,
) -> DatasetSettings:
    """Return the settings of a dataset preset with the caller's changes.

    Args:
        name: one of DATASET_PRESETS.
        seed, resolution: replace the preset's value unless None.
        noise_targets: by name; if one is set, they replace all of the preset's targets.
        allow_licences: licences that are allowed in addition to the preset's.
        changes: any other settings by dotted name, such as `scenes.lights.coloured_share`.

    Raises:
        TrilightError: the name is unknown, or values contradict each other.
    """
    with mistakes_of_entry(f"dataset preset {name!r}"):
        settings = DATASET_PRESETS.find(name).settings()
    if not DATASET_PRESETS.is_ours(name) and DATASET_PRESETS.is_ours(settings.build):
        raise TrilightError(
            f"dataset preset {name!r}: its settings say build={settings.build!r}, which is one of "
            f"Trilight's own; expected another name, such as dataclasses.replace(..., "
            f"build='my-{settings.build}')."
        )
    settings = apply_overrides(settings, option_overrides(seed, resolution, noise_targets or {}))
    licences = tuple(sorted({*settings.allowed_licences, *allow_licences}))
    return apply_overrides(dataclasses.replace(settings, allowed_licences=licences), changes or {})


def option_overrides(
    seed: int | None, resolution: int | None, noise_targets: Targets
) -> dict[str, Any]:
    """Return the settings that single options state, by dotted name; None states nothing."""
    stated = {"seed": seed, "renders.resolution": resolution}
    changes: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    return changes | {f"renders.{name}": db for name, db in target_overrides(noise_targets).items()}


def frozen_note(preset: str, statistics: Statistics) -> tuple[str, ...]:
    """Return a note that compares the scenes of a frozen set with the published digest."""
    named = DATASET_PRESETS[preset]
    if named.scene_digest is None or statistics.num_scenes != named.num_scenes:
        return ()
    if statistics.scene_digest == named.scene_digest:
        return (f"these are the published {named.num_scenes} scenes of {preset}",)
    return (
        f"the scene digest is {statistics.scene_digest}; the published scenes of {preset} have "
        f"{named.scene_digest}. These are other scenes, so figures cannot be compared: install "
        "the exact versions with make setup",
    )
