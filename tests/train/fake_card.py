"""The card that is not there, for tests: skipped where it cannot be had."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from infra.fake_card.card import CARD, fake_card
from infra.fake_card.process import card_process as process_with_card
from storage.errors import TrilightError

__all__ = ["CARD", "card_process", "fake_card"]


@contextmanager
def card_process(folder: Path) -> Iterator[ProcessPoolExecutor]:
    """Yield a process that may use `fake_card`; skip the test where there can be none."""
    with ExitStack() as stack:
        try:
            process = stack.enter_context(process_with_card(folder))
        except TrilightError as error:
            pytest.skip(str(error))
        yield process
