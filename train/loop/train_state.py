"""Mutable state of a run: weights, their mean (EMA), optimizer state, counters and history.

Everything else (order, augmentation, learning rate) is a function of the settings and the step, so
that no state of a random generator has to be saved.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from model.renderformer import RenderFormer
from model.width_scales import scale_start, width_scales
from storage.seeds import seed_for
from train.data.bad_samples import BadSampleCounter
from train.data.order import Mixture
from train.loop.optimizer import Optimizer, Updates, move_towards
from train.resume import Event
from train.settings import Precision, TrainSettings

if TYPE_CHECKING:
    from train.loop.step import StepReport

_SKIP_ADVICE = (
    "To replace such samples by others, allow a number of them: --skip-unusable, with --resume "
    "where the run has begun."
)


@dataclass(kw_only=True, eq=False)
class TrainState:
    """State of a run between two steps."""

    settings: TrainSettings
    """Settings of the next step."""
    model: RenderFormer
    """Network that is trained."""
    optimizer: Optimizer
    """Optimizers of the weights of `model`."""
    bad_samples: BadSampleCounter
    """Counter of damaged samples so far, with its limit."""
    ema_model: RenderFormer | None = None
    """Exponential moving average (EMA) of the weights; None if `ema_decay` is 0."""
    step: int = 0
    """Steps done, including skipped ones; also the position in the data."""
    skipped_steps: int = 0
    """Steps that were not finite and changed nothing."""
    skipped_in_a_row: int = 0
    """Number of skipped steps since the last update, or since a decision about the run."""
    reports: "list[StepReport]" = field(default_factory=list)
    """Reports of the steps since the last row of the log, which the next row averages."""
    history: tuple[Event, ...] = ()
    """Events of the run, oldest first (train.resume)."""
    data_digest: str = ""
    """Digest of the data of this call."""
    mixture: Mixture | None = None
    """Mixture of its datasets; None if there has only been one."""

    @property
    def eval_model(self) -> RenderFormer:
        """Network that is evaluated and saved: the EMA if there is one."""
        return self.ema_model or self.model

    @property
    def updates(self) -> int:
        """Number of updates of the weights."""
        return self.step - self.skipped_steps

    @torch.no_grad()
    def update_ema(self, updates: Updates, skip: Tensor | None) -> None:
        """Update the EMA after an update of the weights, the first one after 0 `updates`.

        After n updates its decay is at most (1 + n) / (10 + n), so that it forgets the random
        start. `skip` is as in `move_towards`.
        """
        if self.ema_model is not None:
            share = ema_step(self.settings.ema_decay, updates)
            move_towards([*self.ema_model.parameters()], [*self.model.parameters()], share, skip)


def ema_step(decay: float, updates: Updates) -> float | Tensor:
    """Return the fraction by which the EMA moves to the weights after so many updates.

    For updates that only the device knows it is float32 [] there.
    """
    early = (1 + updates) / (10 + updates)
    if isinstance(early, Tensor):
        return (1 - early.clamp(max=decay)).float()
    return 1 - min(decay, early)


def new_state(
    settings: TrainSettings,
    device: torch.device | None = None,
    begin_with: RenderFormer | None = None,
    muon_precision: Precision = "bfloat16",
    bad_counts: Mapping[str, int] | None = None,
) -> TrainState:
    """Return the state before the first step.

    Args:
        settings: settings of the run; they alone decide the random weights.
        device: device of the network; by default the CPU.
        begin_with: network of the same configuration whose weights are copied.
        muon_precision: precision of Muon's products (loop.optimizer.choose_muon_precision).
        bad_counts: damage that the run has met, as `BadSampleCounter.counts` has it.
    """
    model = RenderFormer(settings.model)
    if begin_with is None:
        model.initialize(torch.Generator().manual_seed(seed_for(settings.seed, "weights")))
        scale_start(model, width_scales(model, settings.base_widths))
    else:
        model.load_state_dict(begin_with.state_dict())
    model.recompute_activations(settings.recompute_activations)
    model.to(device)
    ema_model = copy.deepcopy(model).requires_grad_(False) if settings.ema_decay else None
    return TrainState(
        settings=settings,
        model=model,
        optimizer=Optimizer(model, settings, muon_precision),
        bad_samples=BadSampleCounter(settings.most_unusable, bad_counts, advice=_SKIP_ADVICE),
        ema_model=ema_model,
    )
