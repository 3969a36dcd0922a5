"""The triangle budget: which objects are drawn to fit, under which licences, at which level."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.scenes import triangle_budget
from pipeline.scenes.triangle_budget import (
    FitTable,
    PooledAsset,
    draw_rows,
    least_triangles,
    levels_within,
)
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from storage.errors import Rejected
from storage.licences import share_alike_camp
from storage.records.asset import Asset, Level, LevelRecord
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE, first_scene, small_pool, with_error

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


def _sample_assets(rng: np.random.Generator, most: int = 4) -> list[Asset]:
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
        assets, total = _sample_assets(rng), int(rng.integers(100, 3000))
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
        assets, total = _sample_assets(rng, most=3), int(rng.integers(100, 2500))
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


def test_too_little_room_is_rejected_with_the_numbers() -> None:
    with pytest.raises(Rejected, match="1 objects need 300 triangles at least.*has 200"):
        levels_within([_asset([(300, 0.1), (600, 0.0)])], 200, 0.0)
    with pytest.raises(Rejected, match="3 objects of at least 50 .* into the 149") as caught:
        draw_rows(np.random.default_rng(0), FitTable.of([50, 80]), 3, 149)
    assert caught.value.reason == "over_budget"
    with pytest.raises(Rejected, match="do not fit"):
        draw_rows(np.random.default_rng(0), FitTable.of([5, 5], ["a", "b"]), 3, 14)


LICENCES = ("CC-BY-SA-4.0", "CC-BY-SA-3.0", "CC0-1.0", "cc-by-sa-4.0", "GPL-3.0-only")
SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)


def _under(licences: Sequence[str]) -> list[PooledAsset]:
    return [
        dataclasses.replace(entry, locked=dataclasses.replace(entry.locked, licence=licence))
        for entry, licence in zip(small_pool(), licences, strict=True)
    ]


def _scenes(licences: Sequence[str], count: int) -> list[Scene]:
    pool = _under(licences)
    return [first_scene(SETTINGS, pool, seed=5, scene_index=index) for index in range(count)]


def test_no_scene_mixes_two_share_alike_licences_and_one_changes_none() -> None:
    camps = Counter[frozenset[str]]()
    for scene in _scenes(LICENCES, 30):
        uids = {entry.uid for entry in scene.objects if entry.kind == "object"}
        met = {entry.licence for entry in scene.objects if entry.uid in uids}
        camps[frozenset(filter(None, map(share_alike_camp, met)))] += 1
    assert max(len(met) for met in camps) == 1
    assert len(camps) == 4  # each of the three licences, and none: the draw reaches them all
    # Frozen sets stay what they are: a rule that does not bind takes no number.
    usual = [scene_digest(scene) for scene in _scenes(["CC0-1.0"] * 5, 6)]
    one = [scene_digest(scene) for scene in _scenes(["CC-BY-SA-4.0", *["MIT"] * 4], 6)]
    assert one == usual


def _slow_twin(
    rng: np.random.Generator, least: Sequence[int], camps: Sequence[str], count: int, total: int
) -> list[int] | None:
    """Look at every row for each object, and at every row after each of them."""
    allowed, left, drawn = set(range(len(least))), total, list[int]()
    for following in range(count - 1, -1, -1):
        fitting_rows = []
        for row in sorted(allowed):
            beside = [
                least[other]
                for other in allowed
                if not camps[row] or camps[other] in ("", camps[row])
            ]
            if least[row] + following * min(beside) <= left:
                fitting_rows.append(row)
        if not fitting_rows:
            return None
        row = fitting_rows[int(rng.integers(len(fitting_rows)))]
        drawn.append(row)
        left -= least[row]
        if camps[row]:
            allowed = {other for other in allowed if camps[other] in ("", camps[row])}
    return drawn


def test_parts_change_no_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangle_budget, "_CHUNK", 7)
    rejected = several = 0
    for trial in range(300):
        rng = np.random.default_rng(trial)
        num_rows, count = int(rng.integers(1, 40)), int(rng.integers(1, 5))
        least = rng.integers(1, 100, num_rows).tolist()
        camps = rng.choice(["", "", "a", "b"], num_rows).tolist()
        total = int(rng.integers(1, 300))
        expected = _slow_twin(np.random.default_rng(trial), least, camps, count, total)
        table = FitTable.of(least, camps)
        try:
            assert draw_rows(np.random.default_rng(trial), table, count, total) == expected
        except Rejected:
            assert expected is None
        rejected += expected is None
        several += bool(expected) and max(expected or [0]) >= 7
    assert 15 < rejected < 150
    assert several > 75


def test_no_row_is_looked_at_where_all_fit() -> None:
    """Of a million objects, two are read for each that is drawn."""

    class Counting:
        def __init__(self, values: Sequence[int]) -> None:
            self.values, self.read = np.array(values), 0

        def __len__(self) -> int:
            return len(self.values)

        def __getitem__(self, rows: slice) -> np.ndarray:
            found = self.values[rows]
            self.read += len(found)
            return found

    least, camp = Counting(range(1, 1001)), Counting([0] * 1000)
    table = FitTable(least, camp, [""], FitTable.of(range(1, 1001)).sizes)
    draw_rows(np.random.default_rng(0), table, 3, 3000)
    assert (least.read, camp.read) == (3, 3)
    draw_rows(np.random.default_rng(0), table, 3, 2000)
    assert least.read > 1000
