"""One update of the weights, or none: a step that is not finite changes nothing.

What a step did is known where it was computed. On a processor the host reads it at once, on a card
once a window (trainer): until then the host goes on telling the card what to do.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from model.precision import quick_products
from storage.errors import TrilightError
from train.data.buckets import TrainingBatch
from train.loop.compiled import compile_parts, is_of_the_compiler, undo_compiling
from train.loop.crew import Crew
from train.loop.decision import decided, decides_late
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


Unread = Tensor
"""What a step did, float64 [7] on the device: loss, L1, shown and wanted brightness, length of the
gradient, whether it was applied, and whether a process was asked to stop."""


@dataclass(frozen=True, kw_only=True)
class ReadSteps:
    """What some steps did, once it is known."""

    reports: list[StepReport]
    """Of each."""
    asked_to_stop: bool
    """Whether a process was, before one of them; alike in all processes."""


class Stepper:
    """Follows the gradient of a state's network, together with the other processes."""

    def __init__(
        self, state: TrainState, settings: TrainSettings, objective: Objective, crew: Crew
    ) -> None:
        self._state = state
        self._settings = settings
        self._objective = objective
        self._crew = crew
        self.is_late = decides_late(crew.device)
        self._updates = torch.full(
            (), float(state.updates), dtype=torch.float64, device=crew.device
        )
        self.activity = Activity()
        self.layers = LayerNorms(state.model)
        self.is_compiled = compile_parts(state.model, objective, settings.compile, crew.device)
        self.remarks: list[str] = []  # for the notes of the run
        self._net: nn.Module = state.model
        if crew.world_size > 1:
            # Every weight is used. Told so, torch would regroup the gradients after the first step,
            # sum them in another order from then on, and a resumed run would differ by a bit.
            self._net = DistributedDataParallel(
                state.model, broadcast_buffers=False, find_unused_parameters=True
            )

    def step(self, batches: Sequence[TrainingBatch], learning_rate: float) -> StepReport:
        """Take a step and wait until it is known what it did; see `take`."""
        (report,) = self.read([self.take(batches, learning_rate)]).reports
        return report

    def take(
        self,
        batches: Sequence[TrainingBatch],
        learning_rate: float,
        *,
        asked_to_stop: bool = False,
    ) -> Unread:
        """Average the gradient over all views of this process's `batches`, and of all processes.

        A card is not waited for: what the step did is there when it is read.

        Args:
            batches: of this process; every process must hold equally many views.
            learning_rate: of AdamW's step.
            asked_to_stop: whether this process was; all are told with the step's figures.

        Raises:
            TrilightError: torch cannot compile the network, and was told to, or there are several
                processes; one that was not told to goes on without.
        """
        try:
            return self._taken(batches, learning_rate, asked_to_stop=asked_to_stop)
        except Exception as error:
            if not (self.is_compiled and is_of_the_compiler(error)):
                raise
            self._leave_compiler(error)
        return self._taken(batches, learning_rate, asked_to_stop=asked_to_stop)

    def _leave_compiler(self, error: Exception) -> None:
        """Go on kernel by kernel: the weights have not moved yet."""
        reason = f"torch {torch.__version__} cannot compile the network ({type(error).__name__})"
        if self._settings.compile == "yes" or self._crew.world_size > 1:
            raise TrilightError(
                f"training: {reason}; expected a version that can. Say --set compile=no, with "
                "--resume where there is a checkpoint, or install another torch."
            ) from error
        undo_compiling(self._state.model, self._objective)
        self.is_compiled = False
        self.remarks.append(f"{reason}: it runs kernel by kernel, which takes longer")

    def _taken(
        self, batches: Sequence[TrainingBatch], learning_rate: float, *, asked_to_stop: bool
    ) -> Unread:
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
        asked = torch.full_like(sums[:1], float(asked_to_stop))
        means = self._crew.mean_on_device(torch.cat([sums / num_views, asked]))
        activity.begin("optimiser")
        applied = self._move(means[0], norm, learning_rate)
        activity.begin("other")
        return torch.cat([means[:4], torch.stack([norm.to(means), applied.to(means)]), means[4:]])

    @torch.no_grad()
    def _move(self, loss: Tensor, norm: Tensor, learning_rate: float) -> Tensor:
        """Move weights and mean where the step is finite; return bool [], whether it is."""
        state = self._state
        updates = self._updates if self.is_late else state.updates
        decision = decided(loss, norm, updates, is_late=self.is_late)
        state.updater.step(learning_rate, decision)
        state.follow_with_mean(self._settings.ema_decay, decision)
        self._updates += decision.applied
        self.layers.updated()
        return decision.applied

    def read(self, steps: Sequence[Unread]) -> ReadSteps:
        """Wait for steps, and for the layers' figures where they were asked for, in one copy."""
        self.activity.begin("device")
        layers = self.layers.unread()
        parts = [*steps, *([] if layers is None else [layers.to(steps[0]).flatten()])]
        values = torch.cat(parts).tolist()
        self.activity.begin("other")
        width = len(steps[0])
        rows = [values[width * row : width * (row + 1)] for row in range(len(steps))]
        if layers is not None:
            self.layers.read(values[width * len(steps) :])
        return ReadSteps(
            reports=[_report(row) for row in rows], asked_to_stop=any(row[-1] > 0 for row in rows)
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
        with quick_products(self._crew.device, wanted=self._settings.precision == "bfloat16"):
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


def _report(figures: Sequence[float]) -> StepReport:
    loss, l1, shown, wanted, grad_norm, applied, _ = figures
    return StepReport(
        loss=loss,
        l1=l1,
        brightness=shown / wanted if wanted > 0 else 1.0,
        grad_norm=grad_norm,
        applied=bool(applied),
    )


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
