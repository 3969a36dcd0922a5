"""Axes along which scenes are told apart, and the strata of a build: one for each combination.

Each axis halves a build's own ranges, so that a half is known by the settings that draw it, and
how often the build draws it follows from them.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scene_templates.settings import SceneSettings
from scene_templates.strata import Stratum
from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True)
class AxisHalf:
    """One half of an axis."""

    name: str
    """Unique over all axes."""
    share: float
    """Share of the build's scenes."""
    families: tuple[str, ...] = ()
    """Families that it is drawn from; empty for all."""
    changes: Mapping[str, Any]
    """Scene settings that draw this half."""


def _counts(scenes: SceneSettings) -> Sequence[AxisHalf]:
    low, high = scenes.lights.count
    middle = (low + high) // 2
    few, all_counts = middle - low + 1, high - low + 1
    return (
        AxisHalf(
            name="few_lights", share=few / all_counts, changes={"lights.count": [low, middle]}
        ),
        AxisHalf(
            name="many_lights",
            share=1 - few / all_counts,
            changes={"lights.count": [middle + 1, high]},
        ),
    )


def _roughness(scenes: SceneSettings) -> Sequence[AxisHalf]:
    low, high = scenes.materials.roughness_log
    middle = (low * high) ** 0.5  # the range is uniform in the logarithm
    return tuple(
        AxisHalf(name=name, share=0.5, changes={"materials.roughness_log": ends})
        for name, ends in (("glossy", [low, middle]), ("rough", [middle, high]))
    )


def _by_family(
    few: str, many: str, size: Callable[[Any], int]
) -> Callable[[SceneSettings], Sequence[AxisHalf]]:
    """Return an axis of families: below the middle of their sizes, and the others."""

    def halves(scenes: SceneSettings) -> Sequence[AxisHalf]:
        sizes = sorted({size(family) for family in scenes.families})
        middle = sizes[(len(sizes) - 1) // 2]
        total = sum(family.weight for family in scenes.families)
        parts = {
            few: [family for family in scenes.families if size(family) <= middle],
            many: [family for family in scenes.families if size(family) > middle],
        }
        return tuple(
            AxisHalf(
                name=name,
                share=sum(family.weight for family in part) / total,
                families=tuple(family.name for family in part),
                changes={},
            )
            for name, part in parts.items()
        )

    return halves


AXES: Mapping[str, Callable[[SceneSettings], Sequence[AxisHalf]]] = {
    "walls": _by_family("few_walls", "many_walls", lambda family: family.shell_triangles),
    "objects": _by_family("few_objects", "many_objects", lambda family: family.num_objects[1]),
    "lights": _counts,
    "roughness": _roughness,
}
"""By name: the two halves of an axis in some scene settings. Roughness is that of all surfaces of a
scene alike, where a build without strata draws it for each surface by itself."""


def strata_of(scenes: SceneSettings, axes: Sequence[str]) -> tuple[Stratum, ...]:
    """Return a stratum for each combination of halves, weighted as the build draws them.

    Raises:
        TrilightError: an axis is named twice, or cannot be halved in these settings; the settings
            have strata of their own.
    """
    if scenes.strata:
        raise TrilightError(
            f"improve: the build has {len(scenes.strata)} strata of its own; expected a build "
            "without scenes.strata, which improve makes from its axes."
        )
    if len(set(axes)) != len(axes) or not axes:
        raise TrilightError(f"improve: axes are {list(axes)}; expected each once, at least one.")
    combined = []
    for halves in itertools.product(*(_halves(scenes, axis) for axis in axes)):
        stratum = _stratum(halves, scenes)
        if stratum is not None:
            combined.append(stratum)
    return tuple(combined)


def halves_of(stratum: str) -> tuple[str, ...]:
    """Return the names of the halves that a stratum's name combines."""
    return tuple(stratum.split())


def _halves(scenes: SceneSettings, axis: str) -> Sequence[AxisHalf]:
    halves = AXES[axis](scenes)
    if any(half.share <= 0 for half in halves):
        raise TrilightError(
            f"improve: axis {axis} cannot be halved: all scenes of the build are alike there; "
            f"expected other axes of {', '.join(AXES)}, or a build with a wider range."
        )
    return halves


def _stratum(halves: Sequence[AxisHalf], scenes: SceneSettings) -> Stratum | None:
    """Return the combination; None where no family is in all of its halves."""
    weights = {family.name: family.weight for family in scenes.families}
    names = set(weights)
    for half in halves:
        names &= set(half.families or weights)
    if not names:
        return None
    share = sum(weights[name] for name in names) / sum(weights.values())
    for half in halves:
        share *= 1.0 if half.families else half.share
    changes = {name: value for half in halves for name, value in half.changes.items()}
    return Stratum(
        name=" ".join(half.name for half in halves),
        weight=share,
        families=tuple(name for name in weights if name in names)
        if len(names) < len(weights)
        else (),
        changes=tuple(changes.items()),
    )
