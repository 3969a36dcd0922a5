"""A bench with one child that does as the test says."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.assets import stage
from pipeline.isolation import call_failures
from tests.pipeline.assets.child_kit import Bench, recorded_attempt


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(stage, "attempt_in_child", recorded_attempt)
    monkeypatch.setattr(call_failures, "_PAUSE_S", 0.0)
    bench = Bench(tmp_path / "sources")
    yield bench
    bench.child.close()
