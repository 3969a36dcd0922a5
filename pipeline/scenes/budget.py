"""The triangle budget: chooses a level of detail for each object within one limit per scene.

A limit per object would either waste most of a scene's triangles or overflow it (the published
recipes do both). Here objects are drawn among those that still fit; each begins with its coarsest
level. The object with the largest distance to its source gets the next finer level, until all are
near enough or no finer level fits.
"""

from collections.abc import Sequence

from storage.errors import Rejected
from storage.records.asset import Asset, Level


def levels_within(
    assets: Sequence[Asset], num_triangles: int, enough_error: float
) -> tuple[Level, ...]:
    """Choose one level per asset, together at most `num_triangles`.

    Args:
        assets: assets whose coarsest levels fit together (`draw_rows`).
        num_triangles: most triangles of all assets together.
        enough_error: two-way distance to the source (99th percentile, fraction of the diagonal)
            below which an asset is not refined.

    Raises:
        Rejected: "over_budget" if the coarsest levels do not fit.
    """
    ladders = [sorted(asset.levels, key=_size) for asset in assets]
    rungs = [0] * len(assets)
    remaining = num_triangles - sum(_size(ladder[0]) for ladder in ladders)
    if remaining < 0:
        raise Rejected(
            "over_budget",
            f"{len(assets)} objects need {num_triangles - remaining} triangles at least, and the "
            f"scene has {num_triangles} for them",
        )
    while True:
        finer = [
            (ladder[rung].record.quality.error_p99, -row)
            for row, (ladder, rung) in enumerate(zip(ladders, rungs, strict=True))
            if rung + 1 < len(ladder)
            and ladder[rung].record.quality.error_p99 > enough_error
            and _size(ladder[rung + 1]) - _size(ladder[rung]) <= remaining
        ]
        if not finer:
            return tuple(ladder[rung] for ladder, rung in zip(ladders, rungs, strict=True))
        row = -max(finer)[1]  # the first of equals
        remaining -= _size(ladders[row][rungs[row] + 1]) - _size(ladders[row][rungs[row]])
        rungs[row] += 1


def least_triangles(asset: Asset) -> int:
    """Return the triangles of the coarsest level."""
    return min(_size(level) for level in asset.levels)


def _size(level: Level) -> int:
    return len(level.faces)
