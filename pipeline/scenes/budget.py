"""The triangle budget: one limit per scene, shared among its objects.

A limit per object would either waste most of a scene's triangles or overflow it (the published
recipes do both). Objects that need few triangles come first, and what they leave goes to the rest.
"""

from collections.abc import Sequence

from storage.asset import Asset, Level
from storage.errors import Rejected


def levels_within(assets: Sequence[Asset], num_triangles: int) -> tuple[Level, ...]:
    """Choose one level per asset, together at most `num_triangles`.

    Raises:
        Rejected: "over_budget" where an object has no level small enough for its share.
    """
    chosen: dict[int, Level] = {}
    left = num_triangles
    for row in sorted(range(len(assets)), key=lambda row: _finest(assets[row])):
        share = left // (len(assets) - len(chosen))
        level = assets[row].finest_within(share)
        if level is None:
            smallest = min(len(level.faces) for level in assets[row].levels)
            raise Rejected(
                "over_budget",
                f"an object of at least {smallest} triangles has a share of {share} of the scene's "
                f"{num_triangles} for objects",
            )
        chosen[row] = level
        left -= len(level.faces)
    return _refined(assets, tuple(chosen[row] for row in range(len(assets))), left)


def _finest(asset: Asset) -> int:
    return max(len(level.faces) for level in asset.levels)


def _refined(assets: Sequence[Asset], levels: tuple[Level, ...], left: int) -> tuple[Level, ...]:
    """Spend what is left over on finer levels, for the object with the most detail first."""
    refined = list(levels)
    for row in sorted(range(len(assets)), key=lambda row: -_finest(assets[row])):
        finer = assets[row].finest_within(len(refined[row].faces) + left)
        if finer is not None:
            left -= len(finer.faces) - len(refined[row].faces)
            refined[row] = finer
    return tuple(refined)
