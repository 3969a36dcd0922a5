"""Statistics of the steps since the last row of the log, and the device's peak speed."""

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import torch

from train.loop.step import StepReport


class Window:
    """Accumulates steps until a row of the log is written."""

    def __init__(self, reports: list[StepReport]) -> None:
        """Begin with steps of an earlier call, whose losses count and whose time does not.

        Args:
            reports: reports of those steps; the window appends to this list.
        """
        self._reports = reports
        self._began = time.monotonic()
        self._views = 0
        self._waited_s = 0.0
        self._flops = 0.0

    def add(self, report: StepReport) -> None:
        """Append the report of one step."""
        self._reports.append(report)

    def add_cost(self, *, views: int, waited_s: float, flops: float) -> None:
        """Add the cost of one step.

        Args:
            views: number of views over all processes.
            waited_s: seconds in which the network waited for data.
            flops: FLOPs of this process's scenes, without padding.
        """
        self._views += views
        self._waited_s += waited_s
        self._flops += flops

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Exclude the time of a block from the window's, for validation and checkpoints."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._began += time.monotonic() - began

    @property
    def views_per_s(self) -> float:
        """Views of all processes per second so far."""
        return self._views / self._seconds()

    def row(self, peak_flops_per_s: float) -> dict[str, Any]:
        """Return the log's values of these steps; a mean is None if no step was finite."""
        return {
            "loss": _finite_mean(report.loss for report in self._reports),
            "l1": _finite_mean(report.l1 for report in self._reports),
            "grad_norm": _finite_mean(report.grad_norm for report in self._reports),
            "views_per_s": self.views_per_s,
            "data_wait_share": self._waited_s / self._seconds(),
            "flops_per_s": self._flops / self._seconds(),
            "peak_share": self._flops / self._seconds() / peak_flops_per_s,
        }

    def _seconds(self) -> float:
        return max(time.monotonic() - self._began, 1e-9)


def _finite_mean(values: Iterable[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


PEAK_WIDTH = {"cpu": 1024, "cuda": 8192}
"""Width of the square matrix product that measures a device's peak speed, by device type."""


@lru_cache
def device_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Return the FLOPs per second of a large square matrix product: the best of five.

    Measuring takes some milliseconds, once. The data sheet's figure is not used, since no program
    reaches it.
    """
    width = PEAK_WIDTH[device.type]
    matrix = torch.ones(width, width, dtype=dtype, device=device)
    best = float("inf")
    for _ in range(5):
        began = time.perf_counter()
        product = matrix @ matrix
        product[0, 0].item()  # waits until it is done
        best = min(best, time.perf_counter() - began)
    return 2 * width**3 / best
