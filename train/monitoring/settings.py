"""Monitoring settings of a run; they decide no weight and may differ at every resume."""

from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within

OnHang = Literal["wait", "stop"]
"""Action when a step does not end."""


@checked("watch settings")
class WatchSettings:
    """Monitoring of a run; decides no weight."""

    hang_after_s: Annotated[float, Within(0.1, 1e6, unit="seconds")] = 120.0
    """Time after which a step may count as hanging; before three of its kind are known, five times
    as long."""
    hang_factor: Annotated[float, Within(1, 1e6, unit="x the usual")] = 10.0
    """Multiple of the usual time from which on a step counts as hanging."""
    on_hang: OnHang = "wait"
    """Action on a hang, after it is reported and the stacks of all threads are written: wait, or
    stop the run, which --resume continues from the last checkpoint."""
    spike_bound: Annotated[float, Within(1, 1e6, unit="deviations")] = 8.0
    """Robust standard deviations above the recent median at which a loss or gradient is recorded
    with the scenes of its step."""
    profile: Annotated[int, Within(0, 1000, unit="steps")] = 0
    """Number of steps to trace with PyTorch's profiler, after the first three; 0 traces none."""
    wandb: str | None = None
    """Project of Weights & Biases that the log is written to as well, if the package is installed;
    offline unless WANDB_MODE says otherwise. By default nothing is."""
