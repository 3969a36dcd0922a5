"""Error message with a remedy, in place of a traceback, when a step runs out of memory."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from storage.errors import TrilightError
from train.settings import TrainSettings

_SAID_ON_CPU = "can't allocate memory"
"""Text of torch's error on a CPU without enough memory; on a GPU the error has its own class."""


@contextmanager
def explain_out_of_memory(settings: TrainSettings, step: int) -> Iterator[None]:
    """Convert out-of-memory errors of the block into a TrilightError with remedies.

    Args:
        step: number of steps that are done.
    """
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        of_memory = isinstance(error, torch.OutOfMemoryError | MemoryError)
        if not of_memory and _SAID_ON_CPU not in str(error):
            raise
        raise TrilightError(
            f"training: too little memory in step {step + 1}; the newest checkpoint is safe. "
            f"{_memory_advice(settings)}"
        ) from error


def _memory_advice(settings: TrainSettings) -> str:
    """Return advice on execution settings that need less memory."""
    most = min(settings.scenes_per_pass, settings.scenes_per_step)
    if most > 1:
        return (
            f"Go on with --resume --set scenes_per_pass={most // 2} instead of {most}, which adds "
            "up the same gradients; --set recompute_activations=true takes less memory too."
        )
    if not settings.recompute_activations:
        return "Go on with --resume --set recompute_activations=true, which takes longer."
    return (
        "One scene at a time and without its activations needs less than any setting can save; "
        "expected a machine with more memory."
    )
