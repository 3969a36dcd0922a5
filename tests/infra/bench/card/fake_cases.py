"""What is measured of a card, on one that is not there (tests.train.fake_card)."""

import contextlib
from typing import Any

import pytest
import torch

from infra.bench.card import ten_steps
from infra.bench.card.effort import CardEffort
from infra.bench.card.ten_steps import steps_of_run
from tests.train.fake_card import CARD, fake_card


@contextlib.contextmanager
def answering_card() -> Any:
    """Have the card answer what only a real one is asked for."""
    with pytest.MonkeyPatch.context() as patch, fake_card():
        for name in ("synchronize", "reset_peak_memory_stats", "empty_cache"):
            patch.setattr(torch.cuda, name, lambda *_: None)
        patch.setattr(torch.cuda, "max_memory_allocated", lambda *_: 3 << 30)
        # nothing is computed, so that no kernel could be seen
        patch.setattr(
            ten_steps,
            "profiled",
            lambda step, device: {"of": str(device), "ran": step(), "kernels": 7},
        )
        yield


def steps_with_memory_for(scenes: int, run: str, effort: CardEffort) -> dict[str, Any]:
    """Return the record of a run's steps on a card with memory for so many scenes a pass."""
    real = ten_steps.drawn_batch

    def limited(settings: Any, wanted: int) -> Any:
        if wanted > scenes:
            raise torch.OutOfMemoryError(f"CUDA out of memory: {wanted} scenes")
        return real(settings, wanted)

    with answering_card(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(ten_steps, "drawn_batch", limited)
        return steps_of_run(run, effort, CARD)
