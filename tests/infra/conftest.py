"""What every test of `infra` may ask for."""

import pytest


@pytest.fixture
def children_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read, convert and trace in this process; that children do so too is tested beside."""
    from tests.infra.child_here import use_children_here

    use_children_here(monkeypatch)
