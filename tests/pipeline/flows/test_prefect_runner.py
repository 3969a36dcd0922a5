"""Prefect's task runs: limits of what they share, and what is tried again."""

import contextlib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from pipeline.flows import prefect_runner as runner
from pipeline.flows.limits import GPU_LIMIT
from tests.for_each import for_each


@for_each(("variant", "held"), [("cuda_ad_rgb", [1]), ("llvm_ad_rgb", [])])
def test_rendering_on_a_card_takes_its_limit(
    monkeypatch: pytest.MonkeyPatch, variant: str, held: list[int]
) -> None:
    taken: list[int] = []

    @contextlib.contextmanager
    def limit(name: str, *, occupy: int, strict: bool) -> Iterator[None]:
        assert name == GPU_LIMIT
        taken.append(occupy)
        yield

    monkeypatch.setattr(runner, "concurrency", limit)
    monkeypatch.setattr(runner, "choose_variant", lambda: SimpleNamespace(name=variant))
    monkeypatch.setattr(runner, "make_task", lambda job, pieces: (job, pieces, list(taken)))
    work = SimpleNamespace(job="job", pieces=())
    assert cast(Any, runner.make_scenes).fn("0", work) == ("job", (), held)


def test_documents_are_tried_again_where_that_can_help() -> None:
    task = cast(Any, runner.write_documents_task)
    assert task.retries == cast(Any, runner.make_scenes).retries > 0
    assert task.retry_condition_fn is runner.may_pass
