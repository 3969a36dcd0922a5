"""What changes while a run goes on: weights, AdamW's memories, their running mean, and counters.

Everything else (order, augmentation, learning rate) is a function of the settings and the step.
"""

from dataclasses import dataclass

import torch

from model.renderformer import RenderFormer
from storage.seeds import seed_for
from train.loop.optim import make_optimizer
from train.settings import TrainSettings


@dataclass(kw_only=True, eq=False)
class TrainState:
    """A run between two steps."""

    model: RenderFormer
    """The weights that are trained."""
    average: RenderFormer
    """Their exponential moving average: what is judged and kept."""
    optimizer: torch.optim.AdamW
    """Over the weights of `model`."""
    step: int = 0
    """Steps done, including skipped ones; also the position in the data."""
    skipped_steps: int = 0
    """Steps that were not finite and changed nothing."""


def new_state(settings: TrainSettings) -> TrainState:
    """Return the state before the first step, which depends on nothing but the settings."""
    model = RenderFormer(settings.model)
    generator = torch.Generator().manual_seed(seed_for(settings.seed, "weights"))
    model.initialise(generator)
    average = RenderFormer(settings.model)
    average.load_state_dict(model.state_dict())
    average.requires_grad_(False)
    return TrainState(model=model, average=average, optimizer=make_optimizer(model, settings))


@torch.no_grad()
def follow(state: TrainState, *, decay: float) -> None:
    """Move the average one step towards the weights.

    The first updates count fully, (1 + n) / (10 + n), so that the random start is soon forgotten.
    """
    updates = state.step - state.skipped_steps
    weight = 1 - min(decay, (1 + updates) / (10 + updates))
    pairs = zip(state.average.parameters(), state.model.parameters(), strict=True)
    for mean, value in pairs:
        mean.lerp_(value, weight)
