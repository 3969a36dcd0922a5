"""Excursions: scenes that leave the usual range along one axis, while all else stays."""

from dataclasses import dataclass
from typing import Annotated, Any

from storage.ranges import FLOAT32_MAX, Within, check_ranges


@dataclass(frozen=True, kw_only=True)
class Excursion:
    """One value beyond the usual range, and the settings that make it."""

    axis: str
    """What is varied, such as `fov_deg`; stands in the provenance of its scenes."""
    value: Annotated[float, Within(-FLOAT32_MAX, FLOAT32_MAX)]
    """Where on the axis; stands there too."""
    changes: tuple[tuple[str, Any], ...]
    """Dotted names of scene settings with their values (storage.changes)."""

    def __post_init__(self) -> None:
        check_ranges(self, "excursion: ")
