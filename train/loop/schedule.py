"""Learning rate of each step: a warm-up, then a constant rate and a decay, or one cosine.

A constant rate does not depend on the number of steps. So until its decay begins, a run is exactly
the first part of any longer run, and can be extended from there (Hägele et al. 2024).
"""

import math

from train.settings import TrainSettings


def decay_start_step(settings: TrainSettings) -> int | None:
    """Return the number of steps after which a constant rate begins to fall.

    None if the schedule has no constant rate, or no decay.
    """
    if settings.schedule != "wsd" or not settings.decay_share:
        return None
    begins = settings.num_steps - round(settings.decay_share * settings.num_steps)
    return max(begins, settings.warmup_steps)


def learning_rate(step: int, settings: TrainSettings) -> float:
    """Return the rate of step 0 ... num_steps - 1, by warmup, constant rate and decay.

    The first is above 0, the last the final one.
    """
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / (settings.warmup_steps + 1)
    if settings.schedule == "cosine":
        fraction = _decay_fraction(step, settings.warmup_steps, settings)
        return _rate_above_final(0.5 * (1 + math.cos(math.pi * fraction)), settings)
    begins = decay_start_step(settings)
    if begins is None or step < begins:
        return settings.learning_rate
    return _rate_above_final(1 - math.sqrt(_decay_fraction(step, begins, settings)), settings)


def _decay_fraction(step: int, begins: int, settings: TrainSettings) -> float:
    """Return the position of a step between the start of a decay and the last step, 0 to 1."""
    return min((step - begins) / max(settings.num_steps - 1 - begins, 1), 1.0)


def _rate_above_final(fraction: float, settings: TrainSettings) -> float:
    """Return the rate at a fraction of the way from the final rate to the peak."""
    final = settings.learning_rate * settings.final_rate_share
    return final + (settings.learning_rate - final) * fraction
