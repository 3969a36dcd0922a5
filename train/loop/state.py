"""What changes while a run goes on: weights, AdamW's memories, two counters, and damage met.

Everything else (order, augmentation, learning rate) is a function of the settings and the step.
"""

from dataclasses import dataclass

import torch

from model.renderformer import RenderFormer
from storage.seeds import seed_for
from train.data.unusable import Unusable
from train.loop.optim import make_optimizer
from train.settings import TrainSettings


@dataclass(kw_only=True, eq=False)
class TrainState:
    """A run between two steps."""

    model: RenderFormer
    """The network."""
    optimizer: torch.optim.AdamW
    """Over the weights of `model`."""
    unusable: Unusable
    """The damaged data that was met so far, and how much there may be."""
    step: int = 0
    """Steps done, including skipped ones; also the position in the data."""
    skipped_steps: int = 0
    """Steps that were not finite and changed nothing."""


def new_state(settings: TrainSettings) -> TrainState:
    """Return the state before the first step, which depends on nothing but the settings."""
    model = RenderFormer(settings.model)
    generator = torch.Generator().manual_seed(seed_for(settings.seed, "weights"))
    model.initialise(generator)
    model.recompute_activations(settings.recompute_activations)
    return TrainState(
        model=model,
        optimizer=make_optimizer(model, settings),
        unusable=Unusable(settings.most_unusable),
    )
