"""What of a machine is ours: what is said, the affinity, and the cards that are visible."""

import os

import pytest

from pipeline.making.machine import cores_owned, visible_gpus
from storage.errors import TrilightError
from tests.for_each import for_each


def test_cores_are_those_of_the_affinity_unless_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRILIGHT_CORES", raising=False)
    before = os.sched_getaffinity(0)
    assert 1 <= cores_owned() <= len(before)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert cores_owned() == 1
    finally:
        os.sched_setaffinity(0, before)
    monkeypatch.setenv("TRILIGHT_CORES", "3")
    assert cores_owned() == 3
    monkeypatch.setenv("TRILIGHT_CORES", "many")
    with pytest.raises(TrilightError, match="TRILIGHT_CORES is 'many'"):
        cores_owned()


@for_each(
    ("value", "cards"),
    [("0,2", ("0", "2")), ("GPU-1a", ("GPU-1a",)), ("", ()), ("-1", ())],
)
def test_cards_are_those_that_are_visible(
    monkeypatch: pytest.MonkeyPatch, value: str, cards: tuple[str, ...]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", value)
    assert visible_gpus() == cards
