"""Traces of some steps by PyTorch's profiler, in the folder of the run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

SKIPPED_STEPS = 3
"""Number of warm-up steps of a call before the first one that is traced."""

_ROWS = 40


class StepProfiler:
    """Traces steps of one process; costs nothing if there are none to trace."""

    def __init__(
        self, steps: int, device: torch.device, folder: Path, note: Callable[[str], None]
    ) -> None:
        """Create the profiler.

        Args:
            steps: number of steps; 0 traces none.
            folder: folder of the trace and the table.
            note: called with a message that names the files.
        """
        self._steps = steps
        self._device = device
        self._folder = folder
        self._note = note
        self._seen = 0
        self._first = 0
        self._profile: Any = None

    def begin_step(self, step: int) -> None:
        """Begin a step, counted from 1."""
        if not self._steps:
            return
        self._seen += 1
        if self._seen == SKIPPED_STEPS + 1:
            from torch.profiler import ProfilerActivity, profile

            on_card = [ProfilerActivity.CUDA] if self._device.type == "cuda" else []
            self._profile = profile(activities=[ProfilerActivity.CPU, *on_card])
            self._profile.start()
            self._first = step

    def end_step(self, step: int) -> None:
        """End a step; write the trace after the last one."""
        if self._profile is not None and step - self._first + 1 == self._steps:
            self._write(step)

    def close(self, step: int) -> None:
        """Write an incomplete trace of a run that has ended."""
        if self._profile is not None:
            self._write(step)
        elif self._steps and self._seen <= SKIPPED_STEPS:
            self._note(
                f"nothing was profiled: the run ended before step {SKIPPED_STEPS + 1} of this call"
            )

    def _write(self, last: int) -> None:
        profiler = self._profile
        self._profile = None
        self._steps = 0
        profiler.stop()
        self._folder.mkdir(parents=True, exist_ok=True)
        trace = self._folder / f"profile-steps-{self._first}-to-{last}.json.gz"
        table = trace.with_name(trace.name.replace(".json.gz", ".txt"))
        profiler.export_chrome_trace(str(trace))
        order = f"self_{self._device.type}_time_total"
        table.write_text(profiler.key_averages().table(sort_by=order, row_limit=_ROWS))
        self._note(
            f"steps {self._first} to {last} were profiled: open {trace} at chrome://tracing in "
            f"Chromium or at ui.perfetto.dev; {table.name} beside it lists the dearest operators"
        )
