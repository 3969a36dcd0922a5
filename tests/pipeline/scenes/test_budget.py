"""Laws of the triangle budget: which objects fit, and which of their levels."""

import itertools

import numpy as np
import pytest

from pipeline.scenes.budget import least_triangles, levels_within
from storage.errors import Rejected
from storage.records.asset import Asset, Level, LevelRecord
from tests.pipeline.scenes.draw_kit import drawn_within
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE, with_error

Rungs = list[tuple[int, float]]
"""Triangles and error of each level."""


def _asset(rungs: Rungs) -> Asset:
    levels = tuple(
        Level(
            record=LevelRecord(budget=count, method="by hand", quality=with_error(QUALITY, error)),
            positions=np.zeros((3, 3), np.float32),
            faces=np.zeros((count, 3), np.uint32),
        )
        for count, error in sorted(rungs, reverse=True)
    )
    return Asset(
        geometry_sha256="", source_sha256="", recipe="by hand", source=SOURCE, levels=levels
    )


def _assets_rand(rng: np.random.Generator, most: int = 4) -> list[Asset]:
    """Assets whose error falls with every triangle more, as it should."""
    assets = []
    for _ in range(rng.integers(1, most + 1)):
        counts = np.unique(rng.integers(4, 1200, size=rng.integers(1, 5)))
        errors = np.sort(rng.choice(np.linspace(0, 0.05, 26), size=len(counts)))[::-1]
        assets.append(_asset(list(zip(counts.tolist(), errors.tolist(), strict=True))))
    return assets


def _error(level: Level) -> float:
    return level.record.quality.error_p99


def _count(levels: tuple[Level, ...]) -> int:
    return sum(len(level.faces) for level in levels)


def test_budgets_hold_and_nothing_that_is_wanted_would_still_fit() -> None:
    rng = np.random.default_rng(0)
    rejected = refined = 0
    for _ in range(500):
        assets, total = _assets_rand(rng), int(rng.integers(100, 3000))
        enough = float(rng.choice([0.0, 0.005, 0.02]))
        try:
            levels = levels_within(assets, total, enough)
        except Rejected as caught:
            assert caught.reason == "over_budget"
            assert sum(least_triangles(asset) for asset in assets) > total
            rejected += 1
            continue
        left = total - _count(levels)
        assert left >= 0
        for asset, level in zip(assets, levels, strict=True):
            assert any(level is one for one in asset.levels)
            refined += len(level.faces) > least_triangles(asset)
            finer = [one for one in asset.levels if len(one.faces) > len(level.faces)]
            following = min(finer, key=lambda one: len(one.faces), default=None)
            if following is not None and _error(level) > enough:
                assert len(following.faces) - len(level.faces) > left
    assert 50 < rejected < 400
    assert refined > 300


def test_the_worst_error_is_the_least_that_the_budget_allows() -> None:
    """Against all combinations: greedy is exact, since each step was needed to get below an error.

    Errors below enough count as enough.
    """
    rng = np.random.default_rng(1)
    compared = better = 0
    for _ in range(400):
        assets, total = _assets_rand(rng, most=3), int(rng.integers(100, 2500))
        enough = float(rng.choice([0.0, 0.01]))
        fitting = [
            combination
            for combination in itertools.product(*(asset.levels for asset in assets))
            if _count(combination) <= total
        ]
        if not fitting:
            with pytest.raises(Rejected):
                levels_within(assets, total, enough)
            continue
        worst = [max(enough, *(_error(level) for level in levels)) for levels in fitting]
        levels = levels_within(assets, total, enough)
        assert max(enough, *(_error(level) for level in levels)) == min(worst)
        compared += 1
        better += min(worst) < max(worst)
    assert compared > 200
    assert better > 100  # else any choice would do


def test_a_larger_budget_is_never_worse() -> None:
    rng = np.random.default_rng(2)
    fell = 0
    for _ in range(100):
        assets = _assets_rand(rng)
        least = sum(least_triangles(asset) for asset in assets)
        before = np.inf
        for total in range(least, least + 3000, 250):
            worst = max(_error(level) for level in levels_within(assets, total, 0.0))
            assert worst <= before
            fell += worst < before < np.inf
            before = worst
    assert fell > 50


def test_without_an_error_that_is_enough_everything_goes_as_fine_as_it_fits() -> None:
    assets = [_asset([(12, 0.03), (300, 0.002)]), _asset([(20, 0.001), (400, 0.0005)])]
    for total, expected in ((32, [12, 20]), (319, [12, 20]), (320, [300, 20]), (700, [300, 400])):
        levels = levels_within(assets, total, 0.0)
        assert [len(level.faces) for level in levels] == expected
    # The second is near enough as it is, and the first when it is finer.
    assert [len(level.faces) for level in levels_within(assets, 700, 0.005)] == [300, 20]
    assert [len(level.faces) for level in levels_within(assets, 700, 0.5)] == [12, 20]


def test_what_a_small_object_leaves_goes_to_a_large_one() -> None:
    small, large = _asset([(12, 0.0)]), _asset([(100, 0.03), (500, 0.02), (900, 0.01)])
    for assets in ([small, large], [large, small]):
        counts = [len(level.faces) for level in levels_within(assets, 1000, 0.0)]
        assert sorted(counts) == [12, 900]


def test_the_first_of_equals_is_refined_first() -> None:
    assets = [_asset([(10, 0.01), (60, 0.0)])] * 3
    counts = [len(level.faces) for level in levels_within(assets, 130, 0.0)]
    assert counts == [60, 60, 10]


def test_too_little_is_rejected_with_the_numbers() -> None:
    with pytest.raises(Rejected, match="1 objects need 300 triangles at least.*has 200"):
        levels_within([_asset([(300, 0.1), (600, 0.0)])], 200, 0.0)
    with pytest.raises(Rejected, match="3 objects of at least 50 .* into the 149") as caught:
        drawn_within(np.random.default_rng(0), "ab", [50, 80], 3, 149)
    assert caught.value.reason == "over_budget"


def test_drawn_objects_always_fit_together() -> None:
    rng = np.random.default_rng(3)
    tight = 0
    for _ in range(400):
        sizes = rng.integers(1, 400, size=rng.integers(1, 12)).tolist()
        count = int(rng.integers(0, 7))
        total = int(count * min(sizes) + rng.integers(0, 900))
        rows = drawn_within(rng, range(len(sizes)), sizes, count, total)
        assert len(rows) == count
        assert sum(sizes[row] for row in rows) <= total
        tight += count * max(sizes) > total
    assert tight > 100


def test_where_only_the_simplest_fits_it_is_taken() -> None:
    rng = np.random.default_rng(4)
    assert drawn_within(rng, "abc", [9, 5, 7], 4, 20) == ["b"] * 4
    # Two left over: the 7 may come once, in any place, and the 9 never.
    found = {"".join(drawn_within(rng, "abc", [9, 5, 7], 3, 17)) for _ in range(200)}
    assert found == {"bbb", "cbb", "bcb", "bbc"}
