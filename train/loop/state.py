"""What changes while a run goes on: weights, mean, memories, counters, damage met, decisions.

Everything else (order, augmentation, learning rate) is a function of the settings and the step;
no random generator's state has to be saved.
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
from train.data.mixture import Mixture
from train.data.unusable import Unusable
from train.going_on import Event
from train.loop.decision import Decision, Updates, move_towards
from train.loop.optim import Updater
from train.settings import Precision, TrainSettings

if TYPE_CHECKING:
    from train.loop.step import StepReport

_WAY_ON = (
    "To replace such samples by others, allow a number of them: --skip-unusable, with --resume "
    "where the run has begun."
)


@dataclass(kw_only=True, eq=False)
class TrainState:
    """A run between two steps."""

    model: RenderFormer
    """The network."""
    updater: Updater
    """Moves the weights of `model`."""
    unusable: Unusable
    """The damaged data that was met so far, and how much there may be."""
    mean_model: RenderFormer | None = None
    """The exponential running mean of its weights (EMA), where the run keeps one."""
    step: int = 0
    """Steps done, including skipped ones; also the position in the data."""
    skipped_steps: int = 0
    """Steps that were not finite and changed nothing."""
    skipped_in_a_row: int = 0
    """Those of them since the last update, or since a decision about the run."""
    reports: "list[StepReport]" = field(default_factory=list)
    """The steps since the last row of the log, whose next row is of them too."""
    history: tuple[Event, ...] = ()
    """What happened to the run beside its steps, oldest first."""
    mixture: Mixture | None = None
    """How its datasets are mixed; None where there has only been one."""

    @property
    def shown(self) -> RenderFormer:
        """The network that is judged and kept: the mean where there is one."""
        return self.mean_model or self.model

    @property
    def updates(self) -> int:
        """How often the weights were moved."""
        return self.step - self.skipped_steps

    @torch.no_grad()
    def follow_with_mean(self, decay: float, decision: Decision) -> None:
        """Move the mean towards the weights after an update, unless it is decided otherwise.

        At first it follows faster, by (1 + n) / (10 + n) after n updates, so that it does not
        remember the random start.
        """
        if self.mean_model is None or decision.is_refused:
            return
        means: list[Tensor] = [*self.mean_model.parameters()]
        weights: list[Tensor] = [*self.model.parameters()]
        move_towards(means, weights, mean_share(decay, decision.updates), decision)


def mean_share(decay: float, updates: Updates) -> float | Tensor:
    """Return the share of its way to the weights that a running mean takes after so many updates.

    Of updates that only the device knows it is float32 [] there.
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
    met: Mapping[str, int] | None = None,
) -> TrainState:
    """Return the state before the first step.

    Args:
        settings: of the run; they alone decide the random weights.
        device: where it is to be; the CPU unless said.
        begin_with: a network of the same configuration whose weights take their place.
        muon_precision: of Muon's products, where the run has Muon (loop.muon.fitting_precision).
        met: damage that the run has met, as `Unusable.met` has it.
    """
    model = RenderFormer(settings.model)
    if begin_with is None:
        model.initialise(torch.Generator().manual_seed(seed_for(settings.seed, "weights")))
        scale_start(model, width_scales(model, settings.base_widths))
    else:
        model.load_state_dict(begin_with.state_dict())
    model.recompute_activations(settings.recompute_activations)
    model.to(device)
    mean_model = None
    if settings.ema_decay:
        mean_model = copy.deepcopy(model).requires_grad_(False)
    return TrainState(
        model=model,
        updater=Updater(model, settings, muon_precision),
        unusable=Unusable(settings.most_unusable, met, way_on=_WAY_ON),
        mean_model=mean_model,
    )
