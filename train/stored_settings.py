"""Stored form of a run's settings, in checkpoints and settings.json.

It includes removed settings, at the values that switched them off, so that files keep their bytes.
"""

from collections.abc import Mapping
from typing import Any

from model.config import REMOVED as REMOVED_FROM_MODEL
from storage.removed import without_removed
from storage.settings.described import settings_record
from train.settings import TrainSettings

_REMOVED = {"model": REMOVED_FROM_MODEL, "loss": {"lpips_precision": "float32"}}
"""Removed settings of each group, with the value that switched them off."""

_BEFORE = {
    "projected_freqs": "rope_max_freq",
    "texture_cells": "material_columns",
    "sky_cells": "texture_cells",
    "lpips_precision": "perceptual_weight",
}
"""Name of the setting after which a removed one is stored."""


def stored_settings(settings: TrainSettings) -> dict[str, Any]:
    """Return the settings as the record that files hold."""
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
