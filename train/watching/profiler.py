"""A trace of some steps by PyTorch's profiler, in the folder of the run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

SKIPPED_STEPS = 3
"""Steps of this call before the first that is traced: they warm up what the others find warm."""

_ROWS = 40


class StepProfiler:
    """Traces steps of one process; without any to trace it costs nothing."""

    def __init__(
        self, steps: int, device: torch.device, folder: Path, noted: Callable[[str], None]
    ) -> None:
        """Take what to trace.

        Args:
            steps: number of steps; 0 traces none.
            device: of the network.
            folder: for the trace and the table.
            noted: is told where they are.
        """
        self._steps, self._device, self._folder, self._noted = steps, device, folder, noted
        self._seen = 0
        self._first = 0
        self._profile: Any = None

    def begins(self, step: int) -> None:
        """Begin a step, from 1."""
        if not self._steps:
            return
        self._seen += 1
        if self._seen == SKIPPED_STEPS + 1:
            from torch.profiler import ProfilerActivity, profile

            on_card = [ProfilerActivity.CUDA] if self._device.type == "cuda" else []
            self._profile = profile(activities=[ProfilerActivity.CPU, *on_card])
            self._profile.start()
            self._first = step

    def ends(self, step: int) -> None:
        """End a step; the last of them writes the trace."""
        if self._profile is not None and step - self._first + 1 == self._steps:
            self._write(step)

    def close(self, step: int) -> None:
        """Write what there is of a run that ended within them."""
        if self._profile is not None:
            self._write(step)
        elif self._steps and self._seen <= SKIPPED_STEPS:
            self._noted(
                f"nothing was profiled: the run ended before step {SKIPPED_STEPS + 1} of this call"
            )

    def _write(self, last: int) -> None:
        found, self._profile, self._steps = self._profile, None, 0
        found.stop()
        self._folder.mkdir(parents=True, exist_ok=True)
        trace = self._folder / f"profile-steps-{self._first}-to-{last}.json.gz"
        table = trace.with_name(trace.name.replace(".json.gz", ".txt"))
        found.export_chrome_trace(str(trace))
        order = f"self_{self._device.type}_time_total"
        table.write_text(found.key_averages().table(sort_by=order, row_limit=_ROWS))
        self._noted(
            f"steps {self._first} to {last} were profiled: open {trace} at chrome://tracing in "
            f"Chromium or at ui.perfetto.dev; {table.name} beside it lists the dearest operators"
        )
