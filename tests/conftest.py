"""What every test may ask for."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real objects, scenes and reference pictures."""
    folder = Path(os.environ.get("TRILIGHT_SHARED", ROOT.parent / "shared"))
    if not (folder / "objects").is_dir():
        pytest.skip(f"no real objects: set TRILIGHT_SHARED ({folder} has no objects/)")
    return folder
