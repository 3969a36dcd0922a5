"""Keeps the page of a run up to date while it is trained."""

import time
from contextlib import suppress

from infra.run_page.page import write_run_page
from storage.errors import TrilightError
from train.folder import RunFolder
from train.progress import TrainProgress

LEAST_WAIT_S = 30.0
"""Least time from one page to the next."""

LEAST_WAIT_FACTOR = 300.0
"""The same as a multiple of what the last page took: a third of a per cent of the training."""


class PageProgress(TrainProgress):
    """Writes the page now and then; a page that cannot be written stops no training."""

    _next_s = 0.0
    """time.monotonic() from which on the next page is due."""

    def recorded(self, folder: RunFolder) -> None:
        began_s = time.monotonic()
        if began_s < self._next_s:
            return
        with suppress(TrilightError):
            write_run_page(folder.root)
        now_s = time.monotonic()
        self._next_s = now_s + max(LEAST_WAIT_S, LEAST_WAIT_FACTOR * (now_s - began_s))
