"""Families as rows of numbers.

Those of the published recipes are pinned by the digests of their presets
(tests/pipeline/presets/test_registry.py); ours are written down here once more.
"""

from collections.abc import Iterable

from scene_templates.checks import Range
from scene_templates.families import Family
from scene_templates.renderformer_v1 import stage_1_families, stage_2_families

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
