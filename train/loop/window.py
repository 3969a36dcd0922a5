"""Steps since the last row of the log: losses, speed, time spent; and the device's peak."""

import math
import time
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import torch

from train.loop.step import StepReport


class Window:
    """Collects steps until a row is written."""

    def __init__(self, reports: list[StepReport]) -> None:
        """Begin with steps before this call, whose losses count and whose time does not.

        Args:
            reports: of those; is kept up to date.
        """
        self._reports = reports
        self._began = time.monotonic()
        self._views = 0
        self._waited_s = 0.0
        self._flops = 0.0

    def add(self, report: StepReport) -> None:
        """Count what one step did, when it is known."""
        self._reports.append(report)

    def spend(self, *, views: int, waited_s: float, flops: float) -> None:
        """Count what one step took.

        Args:
            views: of all processes.
            waited_s: time in which the network waited for data.
            flops: what this process's scenes need, without padding.
        """
        self._views += views
        self._waited_s += waited_s
        self._flops += flops

    def pause(self) -> "Pause":
        """Return a context whose time does not count, for validation and checkpoints."""
        return Pause(self)

    @property
    def views_per_s(self) -> float:
        """Views of all processes per second so far."""
        return self._views / self._seconds()

    def row(self, peak_flops_per_s: float) -> dict[str, Any]:
        """Return what the log says about these steps; None where no step was finite."""
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

    def leave_out(self, seconds: float) -> None:
        """Do not count some seconds that have passed."""
        self._began += seconds


class Pause:
    """Time that a window does not count."""

    def __init__(self, window: Window) -> None:
        self._window = window

    def __enter__(self) -> None:
        self._began = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._window.leave_out(time.monotonic() - self._began)


def _finite_mean(values: Iterable[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


PEAK_WIDTH = {"cpu": 1024, "cuda": 8192}
"""Width of the square matrix product whose speed counts as the device's peak."""


@lru_cache
def device_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Return the operations per second of a large square product here: the best of five.

    It takes some milliseconds and then the measured value is remembered. No program reaches the
    data sheet's figure.
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
