"""Strata: parts of what a build draws, each with a weight that says how many scenes it makes.

Which stratum a scene belongs to depends on its index alone, so that a scene's distribution can be
read from the settings. Every stretch of scenes, such as a shard, holds each stratum's share to
within a scene or two.
"""

from collections.abc import Sequence
from typing import Annotated, Any

from storage.settings.described import checked
from storage.settings.ranges import Within

_GOLDEN = 11_400_714_819_323_198_485
"""2^64 over the golden ratio: its multiples, modulo 2^64, are spread evenly at every length."""

Weight = Annotated[float, Within(1e-9, 1e9)]


@checked("scene settings")
class Stratum:
    """A part of the scenes, how often it is drawn, and how often it was."""

    name: str
    """Unique name, such as `few_lights rough`; recorded in the provenance of its scenes."""
    weight: Weight
    """How often the stratum is drawn, relative to the others."""
    earlier_weights: tuple[Weight, ...] = ()
    """Its weights in the datasets before this one, oldest first, where a series is made (`trilight
    improve`); they change no scene."""
    families: tuple[str, ...] = ()
    """Names of the families that its scenes are drawn from; by default all."""
    changes: tuple[tuple[str, Any], ...] = ()
    """Scene settings to change, by dotted name, with their values (storage.settings.changes)."""


def stratum_of(strata: Sequence[Stratum], scene_index: int) -> Stratum:
    """Return the stratum of a scene; whole numbers decide, the same on every machine."""
    place = (scene_index * _GOLDEN + _GOLDEN // 2) % 2**64 / 2**64
    place *= sum(stratum.weight for stratum in strata)
    for stratum in strata:
        place -= stratum.weight
        if place < 0:
            return stratum
    return strata[-1]
