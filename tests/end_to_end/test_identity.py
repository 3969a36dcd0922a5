"""What every restructuring keeps byte for byte: see identity.py."""

import json
from pathlib import Path

import pytest

from pipeline.renders.mitsuba_variant import vector_extension
from tests.end_to_end.identity import KEPT, PARTS, SETS, digests_of


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Empty at first: what one set has made of an object, the next one reads."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.slow("every")
@pytest.mark.parametrize("name", [*PARTS, *SETS])
def test_what_is_made_is_what_was_made(
    name: str, shared: Path, tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(cache))
    kept = json.loads(KEPT.read_bytes()).get(vector_extension())
    if kept is None:
        pytest.skip(f"no digests of processors with {vector_extension()}: write them on main")
    expected = {
        key: pytest.approx(value, rel=1e-4) if isinstance(value, float) else value
        for key, value in kept[name].items()
    }
    assert digests_of(name, tmp_path) == expected
