"""What every test may ask for."""

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
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


@pytest.fixture(scope="session")
def card(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessPoolExecutor]:
    """A process with a card that is not there (infra.fake_card); one, for it takes seconds."""
    from tests.train.fake_card import card_process

    with card_process(tmp_path_factory.mktemp("card")) as process:
        yield process
