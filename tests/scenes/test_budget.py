"""Laws of the triangle budget."""

import numpy as np
import pytest

from pipeline.scenes.budget import levels_within
from storage.asset import Asset, Level, LevelRecord
from storage.errors import Rejected
from tests.scenes.small_pool import QUALITY, SOURCE


def _asset(counts: list[int]) -> Asset:
    levels = tuple(
        Level(
            record=LevelRecord(budget=count, method="by hand", quality=QUALITY),
            positions=np.zeros((3, 3), np.float32),
            faces=np.zeros((count, 3), np.uint32),
        )
        for count in sorted(counts, reverse=True)
    )
    return Asset(
        geometry_sha256="", source_sha256="", recipe="by hand", source=SOURCE, levels=levels
    )


def test_budgets_hold_and_no_object_could_be_finer() -> None:
    rng = np.random.default_rng(0)
    rejected = 0
    for _ in range(500):
        assets = [
            _asset(rng.integers(1, 1200, size=rng.integers(1, 5)).tolist())
            for _ in range(rng.integers(1, 5))
        ]
        total = int(rng.integers(100, 1500))
        try:
            levels = levels_within(assets, total)
        except Rejected as caught:
            assert caught.reason == "over_budget"
            rejected += 1
            continue
        left = total - sum(len(level.faces) for level in levels)
        assert left >= 0
        for asset, level in zip(assets, levels, strict=True):
            assert level in asset.levels
            finer = asset.finest_within(len(level.faces) + left)
            assert finer is not None
            assert len(finer.faces) == len(level.faces)
    assert 0 < rejected < 400


def test_what_a_small_object_leaves_goes_to_a_large_one() -> None:
    small, large = _asset([12]), _asset([900, 500, 100])
    for assets in ([small, large], [large, small]):
        counts = [len(level.faces) for level in levels_within(assets, 1000)]
        assert sorted(counts) == [12, 900]


def test_an_even_share_is_never_below_what_is_needed() -> None:
    """If every object has a level within an equal share, the scene is never rejected."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        count = int(rng.integers(1, 5))
        assets = [_asset([100, *rng.integers(100, 2000, size=3).tolist()]) for _ in range(count)]
        levels_within(assets, 100 * count)


def test_an_object_without_a_small_level_is_rejected_with_the_numbers() -> None:
    with pytest.raises(Rejected, match="at least 300 triangles has a share of 200"):
        levels_within([_asset([300, 600])], 200)
