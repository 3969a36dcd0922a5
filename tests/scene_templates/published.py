"""Families as rows of numbers, and the ranges of their sides.

Those of the published recipes are pinned by the digests of their presets
(tests/pipeline/presets/test_registry.py); ours are written down here once more.
"""

import functools
from collections.abc import Iterable, Mapping

from scene_templates.checks import Range
from scene_templates.families import Family
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families

Row = tuple[str, float, tuple[int, int], Range, float]
"""Name, weight, fewest and most objects, diameter of their spheres before halving, smooth share."""


def _rows(families: Iterable[Family]) -> tuple[Row, ...]:
    return tuple(
        (one.name, one.weight, one.num_objects, one.object_scale, one.smooth_share)
        for one in families
    )


STAGE_1 = _rows(stage_1_families("de-biased"))
STAGE_2 = _rows(stage_2_families("de-biased"))

DEFAULT: tuple[Row, ...] = tuple(
    row
    for name in ("plane", "wall", "corner", "open_box")
    for row in (
        (f"{name}-single", 1.0, (1, 1), (1.2, 2.2), 0.5),
        (f"{name}-multi", 2.0, (2, 3), (0.8, 1.8), 0.5),
    )
)
"""Our own families: each layout and each number of objects from 1 to 3 equally often."""

SideRow = tuple[float, float, Range, Range, Range, Range]
"""Most spin and tilt in degrees, scale, and shift along x, y and z before halving."""


@functools.cache
def _families(policy: Policy, stage: int) -> Mapping[str, Family]:
    families = (stage_1_families if stage == 1 else stage_2_families)(policy)
    return {family.name: family for family in families}


def side_row(family: str, part: str, policy: Policy, stage: int) -> SideRow:
    """Return from what a floor or wall of a family is drawn."""
    side = getattr(_families(policy, stage)[family].shell, part)
    return (side.spin_deg, side.tilt_deg, side.scale, side.shift_x, side.shift_y, side.shift_z)
