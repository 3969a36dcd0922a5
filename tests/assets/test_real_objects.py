"""The objects as people publish them: how many make it, and how close they stay."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings
from pipeline.objects.sources import list_objects
from storage.asset import Asset
from storage.records import ObjectRecord

SETTINGS = AssetSettings()


def check(asset: Asset) -> None:
    sizes = [len(level.faces) for level in asset.levels]
    assert sizes == sorted(set(sizes), reverse=True)
    for level in asset.levels:
        assert 1 <= len(level.faces) <= level.record.budget
        assert level.record.error_p99 <= SETTINGS.max_error_p99
        assert np.abs(level.positions).max() <= 0.5 + 0.01 * np.sqrt(3)
        corners = level.positions[level.faces].astype(np.float64)
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.linalg.norm(area, axis=1) > 0).all()


@pytest.fixture(scope="module")
def records(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> list[ObjectRecord]:
    return list_objects(str(shared / "objects"), work_dir=tmp_path_factory.mktemp("work"))


def test_a_cross_section_of_them(records: list[ObjectRecord]) -> None:
    """Every ninth: open banners, flat tiles, many-part furniture, and a scan among them."""
    for record in records[::9]:
        check(prepare_asset(record, SETTINGS))


def test_copies_in_other_colours_share_their_geometry(records: list[ObjectRecord]) -> None:
    digests = {
        record.uid: prepare_asset(record, SETTINGS).geometry_sha256
        for record in records
        if "/banner_pattern" in record.uid or "/bottle_" in record.uid
    }
    groups = Counter(digests.values())
    # Pattern A in four colours; B and C, which differ in their texture only, in seven together;
    # bottles A (three), B and C (two each).
    assert sorted(groups.values()) == [2, 2, 3, 4, 7]


@pytest.mark.slow
def test_all_of_them(records: list[ObjectRecord]) -> None:
    assert len(records) == 148
    for record in records:
        check(prepare_asset(record, SETTINGS))
