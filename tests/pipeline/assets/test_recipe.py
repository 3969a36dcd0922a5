"""An asset's bytes and the number of the recipe that it names change together."""

from pathlib import Path

import pytest

from pipeline.assets.recipe import RECIPE
from pipeline.assets.settings import AssetSettings
from pipeline.making.environment import vector_extension
from pipeline.making.prepare_isolated import prepare_isolated
from pipeline.objects.generated import generate_objects
from storage.digests import canonical_json, sha256_hex

OUTCOMES = {
    ("assets-2", "avx512f"): "5afad93969b7792c2f6bd9a9c333e9e1de192fc769affbb6323b3d82ea48ea61"
}
"""Digest of what became of four built-in objects, by recipe and processor."""


def test_an_outcome_changes_only_with_the_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    records = generate_objects("builtin:4", tmp_path)
    settings = AssetSettings(budgets=(340, 240))
    prepared, failures = prepare_isolated(records, settings, workers=1, done=lambda: None)
    outcomes = [[asset.record.uid, asset.asset_sha256] for asset in prepared]
    digest = sha256_hex(canonical_json([outcomes, [failure.reason for failure in failures]]))
    known = OUTCOMES.get((RECIPE.split()[0], vector_extension()), digest)
    assert digest == known, "raise the number in pipeline/assets/recipe.py, and add a row here"
