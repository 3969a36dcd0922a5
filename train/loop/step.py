"""One update of the weights, or none: a step that is not finite changes nothing."""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from train.data.buckets import TrainingBatch
from train.loop.compiled import compile_parts
from train.loop.crew import Crew
from train.loop.state import TrainState
from train.loss.objective import Objective
from train.settings import Precision, TrainSettings
from train.watching.activity import Activity
from train.watching.layers import LayerNorms


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """What one step did, over all processes."""

    loss: float
    """Mean over the views of the step of all that is minimised."""
    l1: float
    """The first term of the loss alone, unweighted."""
    brightness: float
    """Mean log10(1 + radiance) of the predicted pictures, as a share of the targets'."""
    grad_norm: float
    """Length of the gradient before it was clipped."""
    applied: bool
    """False where loss or gradient was not finite and the weights stayed as they were."""


class Stepper:
    """Follows the gradient of a state's network, together with the other processes."""

    def __init__(
        self, state: TrainState, settings: TrainSettings, objective: Objective, crew: Crew
    ) -> None:
        self._state = state
        self._settings = settings
        self._objective = objective
        self._crew = crew
        self.activity = Activity()
        self.layers = LayerNorms(state.model)
        compile_parts(state.model, objective, settings.compile, crew.device)
        self._net: nn.Module = state.model
        if crew.world_size > 1:
            # Every weight is used. Told so, torch would regroup the gradients after the first step,
            # sum them in another order from then on, and a resumed run would differ by a bit.
            self._net = DistributedDataParallel(
                state.model, broadcast_buffers=False, find_unused_parameters=True
            )

    def step(self, batches: Sequence[TrainingBatch], learning_rate: float) -> StepReport:
        """Average the gradient over all views of this process's `batches`, and of all processes.

        Every process must hold equally many views.
        """
        state, activity = self._state, self.activity
        state.updater.zero_grad()
        num_views = sum(batch.noise_BV.numel() for batch in batches)
        sums = torch.zeros(4, dtype=torch.float64, device=self._crew.device)
        for index, batch in enumerate(batches):
            last = index == len(batches) - 1
            with contextlib.nullcontext() if last else self._apart():
                sums += self._add_gradient(batch.to(self._crew.device), num_views, last=last)
        activity.begin("optimiser")
        self.layers.gradients()
        norm = nn.utils.clip_grad_norm_(state.model.parameters(), self._settings.grad_clip)
        activity.begin("exchange")
        means = self._crew.mean_on_device(sums / num_views)
        activity.begin("device")
        # the one moment of a step in which a card is waited for
        loss, l1, shown, wanted, grad_norm = torch.cat([means, norm.to(means)[None]]).tolist()
        activity.begin("optimiser")
        applied = math.isfinite(grad_norm) and math.isfinite(loss)
        if applied:
            state.updater.step(learning_rate)
            state.follow_with_mean(self._settings.ema_decay)
        activity.begin("other")
        return StepReport(
            loss=loss,
            l1=l1,
            brightness=shown / wanted if wanted > 0 else 1.0,
            grad_norm=grad_norm,
            applied=applied,
        )

    def _add_gradient(self, batch: TrainingBatch, num_views: int, *, last: bool) -> Tensor:
        """Add one batch's part of the gradient; return its sums of loss, L1, shown and wanted."""
        self.activity.begin("forward")
        resolution = batch.target_BVRR3.shape[2]
        prediction = predicted(self._net, batch, resolution, self._settings.precision)
        losses = self._objective(prediction, batch.target_BVRR3, batch.noise_BV)
        self.activity.begin("backward")
        if last and self._crew.world_size > 1:
            prediction.register_hook(self._note_exchange)
        (losses.total_BV.sum() / num_views).backward()
        self.activity.begin("other")
        shown_BV = prediction.detach().clamp(min=0).mean(dim=(2, 3, 4))
        wanted_BV = batch.target_BVRR3.mean(dim=(2, 3, 4))
        parts = [losses.total_BV.detach(), losses.l1_BV, shown_BV, wanted_BV]
        return torch.stack([part.sum() for part in parts]).double()

    def _note_exchange(self, _: Tensor) -> None:
        """Have it noted when this process's gradient is there, before it waits for the others'.

        Torch calls what is queued in a backward pass in turn, and DistributedDataParallel queues
        its waiting later, when the last gradient is there.
        """
        queue = torch.autograd.Variable._execution_engine.queue_callback
        queue(lambda: self.activity.begin("exchange"))

    def _apart(self) -> contextlib.AbstractContextManager[Any]:
        """Return what keeps the processes from exchanging a gradient that is not complete."""
        if isinstance(self._net, DistributedDataParallel):
            context: contextlib.AbstractContextManager[Any] = self._net.no_sync()
            return context
        return contextlib.nullcontext()


def predicted(
    net: Callable[..., Tensor], batch: TrainingBatch, resolution: int, precision: Precision
) -> Tensor:
    """Return log10(1 + radiance) [B, V, R, R, 3] before the ELU, float32.

    With bfloat16 the products of the network are rounded to it, positions are not.
    """
    reduced = precision == "bfloat16"
    with torch.autocast(batch.noise_BV.device.type, torch.bfloat16, enabled=reduced):
        prediction = net(batch.scenes, resolution)
    return prediction.float()
