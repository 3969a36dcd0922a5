"""Packages of other projects for the tests of exports."""

import sys
from collections.abc import Iterator

import pytest

from tests.foreign_packages import foreign_packages


@pytest.fixture(scope="session")
def foreign() -> Iterator[None]:
    """Let the tests import the readers of `requirements/readers.txt`."""
    folder = str(foreign_packages())
    sys.path.append(folder)  # last: what both have is ours
    yield
    sys.path.remove(folder)
