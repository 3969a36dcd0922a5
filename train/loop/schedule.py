"""The learning rate by the step: a warm-up, then a constant rate and a decay, or one cosine.

A constant rate knows nothing of the end. So until its decay begins, a run is to the bit the first
part of any longer one, and what goes on from there is that longer run (Hägele et al. 2024).
"""

import math

from train.settings import TrainSettings


def decay_begins(settings: TrainSettings) -> int | None:
    """Return after how many steps a constant rate begins to fall.

    None where no rate is constant, or where it stays so to the end.
    """
    if settings.schedule != "wsd" or not settings.decay_share:
        return None
    begins = settings.num_steps - round(settings.decay_share * settings.num_steps)
    return max(begins, settings.warmup_steps)


def learning_rate(step: int, settings: TrainSettings) -> float:
    """Return the rate of step 0 ... num_steps - 1; the first is above 0, the last the final one."""
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / (settings.warmup_steps + 1)
    if settings.schedule == "cosine":
        fraction = _part_of(step, settings.warmup_steps, settings)
        return _fallen(0.5 * (1 + math.cos(math.pi * fraction)), settings)
    begins = decay_begins(settings)
    if begins is None or step < begins:
        return settings.learning_rate
    return _fallen(1 - math.sqrt(_part_of(step, begins, settings)), settings)


def _part_of(step: int, begins: int, settings: TrainSettings) -> float:
    """Return how far a step is from where a decay begins to the last step, from 0 to 1."""
    return min((step - begins) / max(settings.num_steps - 1 - begins, 1), 1.0)


def _fallen(share: float, settings: TrainSettings) -> float:
    """Return the rate of which a share is left above the final one."""
    final = settings.learning_rate * settings.final_rate_share
    return final + (settings.learning_rate - final) * share
