"""The render children that this process keeps warm."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from pipeline.isolation import IsolatedChild
from pipeline.making import render_children
from pipeline.making.children import ChildPool
from storage.dataset.layout import DatasetFolder


def test_only_children_that_nobody_uses_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another run may be at work on the same Dask worker."""
    closed: list[str] = []

    def pool(name: str) -> ChildPool:
        child = SimpleNamespace(close=lambda: closed.append(name))
        return ChildPool(lambda number: cast(IsolatedChild, child), 1)

    job = cast(Any, SimpleNamespace(
        folder=DatasetFolder(Path("a")), settings=SimpleNamespace(digest="d"), lock_sha256="l"
    ))  # fmt: skip
    monkeypatch.setattr(render_children, "_pools", {("b", "d", "l"): pool("other")})
    monkeypatch.setattr(render_children, "_render_pool", lambda job: pool("ours"))
    with render_children.render_child(job):
        assert closed == ["other"]
        render_children.close_idle_children()
        assert closed == ["other"]
    render_children.close_idle_children()
    assert closed == ["other", "ours"]
