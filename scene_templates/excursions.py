"""Excursions: scenes that leave the usual range along one axis, while all else stays."""

from typing import Annotated, Any

from storage.settings.described import checked
from storage.settings.ranges import FLOAT32_MAX, Within


@checked("excursion")
class Excursion:
    """One value beyond the usual range, and the settings that make it."""

    axis: str
    """What is varied, such as `fov_deg`; stands in the provenance of its scenes."""
    value: Annotated[int | float, Within(-FLOAT32_MAX, FLOAT32_MAX)]
    """Where on the axis; stands there too."""
    changes: tuple[tuple[str, Any], ...]
    """Dotted names of scene settings with their values (storage.settings.changes)."""
