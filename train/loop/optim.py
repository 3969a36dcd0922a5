"""AdamW and its learning rate: linear warm-up, then one cosine, and no restart after it."""

import math

import torch
from torch import nn

from train.settings import TrainSettings


def make_optimizer(model: nn.Module, settings: TrainSettings) -> torch.optim.AdamW:
    """Return AdamW over all weights; the rate is set anew before each step."""
    return torch.optim.AdamW(
        model.parameters(),
        lr=settings.learning_rate,
        betas=settings.betas,
        weight_decay=settings.weight_decay,
    )


def learning_rate(step: int, settings: TrainSettings) -> float:
    """Return the rate of step 0 ... num_steps - 1; the first is above 0, the last the final one."""
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / (settings.warmup_steps + 1)
    after_warmup = max(settings.num_steps - 1 - settings.warmup_steps, 1)
    fraction = min((step - settings.warmup_steps) / after_warmup, 1.0)
    final = settings.learning_rate * settings.final_rate_share
    cosine = 0.5 * (1 + math.cos(math.pi * fraction))
    return final + (settings.learning_rate - final) * cosine
