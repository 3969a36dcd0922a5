"""Too little memory for a step: one line that says what to do, and no traceback."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from storage.errors import TrilightError
from train.settings import TrainSettings

_SAID_ON_CPU = "can't allocate memory"
"""What torch says where the machine itself has too little; on a card it has a class of its own."""


@contextmanager
def enough_memory(settings: TrainSettings, step: int) -> Iterator[None]:
    """Raise a TrilightError with the ways on where a step finds too little memory.

    Args:
        settings: of the run.
        step: steps that are done.
    """
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        of_memory = isinstance(error, torch.OutOfMemoryError | MemoryError)
        if not of_memory and _SAID_ON_CPU not in str(error):
            raise
        raise TrilightError(
            f"training: too little memory in step {step + 1}; the newest checkpoint is safe. "
            f"{_way_on(settings)}"
        ) from error


def _way_on(settings: TrainSettings) -> str:
    """Return what takes less memory and leaves the run what it is."""
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
