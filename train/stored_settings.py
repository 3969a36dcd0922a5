"""A run's settings as its checkpoints and settings.json hold them.

Removed settings stand there too, at the values that meant none: these files keep their bytes.
"""

from collections.abc import Mapping
from typing import Any

from model.config import REMOVED as REMOVED_FROM_MODEL
from storage.removed import without_removed
from storage.settings.described import settings_record
from train.settings import TrainSettings

_REMOVED = {"model": REMOVED_FROM_MODEL, "loss": {"lpips_precision": "float32"}}
"""Removed settings of each group."""

_BEFORE = {
    "projected_freqs": "rope_max_freq",
    "texture_cells": "material_columns",
    "sky_cells": "texture_cells",
    "lpips_precision": "perceptual_weight",
}
"""The setting behind which a removed one stands."""


def stored_settings(settings: TrainSettings) -> dict[str, Any]:
    """Return the record of settings that is stored."""
    record = settings_record(settings)
    for group, removed in _REMOVED.items():
        for name, off in removed.items():
            entries = list(record[group].items())
            place = list(record[group]).index(_BEFORE[name]) + 1
            record[group] = dict([*entries[:place], (name, off), *entries[place:]])
    return record


def known_settings(record: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return a stored record without removed settings.

    Args:
        record: settings by name; some may be missing.
        source: name of the record in a refusal.

    Raises:
        TrilightError: a removed setting is used.
    """
    known = {
        group: without_removed(record[group], removed, f"{source}: {group}")
        for group, removed in _REMOVED.items()
        if isinstance(record.get(group), Mapping)
    }
    return {**record, **known}
