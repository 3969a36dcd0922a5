"""What every test may ask for."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# No test asserts a time: a crowded machine must not fail what is right.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

ROOT = Path(__file__).parents[1]


@pytest.fixture
def bare_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures out of reports: they take seconds, and tests.documents looks at them."""
    monkeypatch.setattr("pipeline.documents.report._SECTIONS", {})


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real objects, scenes and reference pictures."""
    folder = Path(os.environ.get("TRILIGHT_SHARED", ROOT.parent / "shared"))
    if not (folder / "objects").is_dir():
        pytest.skip(f"no real objects: set TRILIGHT_SHARED ({folder} has no objects/)")
    return folder


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Have each worker begin with tests that may last long: one that came last kept two waiting."""
    workers = getattr(config, "workerinput", {}).get("workercount", 1)
    long = sorted(filter(_patience_s, items), key=_patience_s, reverse=True)
    rest = [item for item in items if not _patience_s(item)]  # in order: they share fixtures
    dealt: list[pytest.Item] = []
    for worker in range(workers):
        own = long[worker::workers]
        room = (len(items) * (worker + 1)) // workers - len(dealt) - len(own)
        dealt += [*own, *rest[:room]]
        rest = rest[room:]
    items[:] = [*dealt, *rest]


def _patience_s(item: pytest.Item) -> float:
    """Return the timeout that a test itself states, s: who lasts long does. Files share servers."""
    stated = (each.args[0] for each in item.own_markers if each.name == "timeout")
    return max(map(float, stated), default=0.0)
