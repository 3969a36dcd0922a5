"""One update of the weights, or none: a step that is not finite changes nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.renderformer import RenderFormer
from train.data.buckets import TrainingBatch


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """What one step did."""

    loss: float
    """Mean over the views of the step."""
    grad_norm: float
    """Length of the gradient before it was clipped."""
    applied: bool
    """False where loss or gradient was not finite and the weights stayed as they were."""


def view_losses(prediction_BVRR3: Tensor, target_BVRR3: Tensor) -> Tensor:
    """Return the L1 error [B, V] of log10(1 + radiance), taken before the output's ELU.

    Zeng et al. 2025, section 4, first term. Before the ELU because its slope is a thousandth for
    negative values: a network that once predicts below 0 would hardly come back. Targets are at
    least 0, so the best prediction is the same.
    """
    return (prediction_BVRR3 - target_BVRR3).abs().mean(dim=(2, 3, 4))


def train_step(
    model: RenderFormer,
    optimizer: torch.optim.Optimizer,
    batches: Sequence[TrainingBatch],
    *,
    resolution: int,
    learning_rate: float,
    grad_clip: float,
) -> StepReport:
    """Average the gradient over all views of `batches` and follow it once."""
    num_views = sum(batch.target_BVRR3.shape[:2].numel() for batch in batches)
    optimizer.zero_grad(set_to_none=True)
    loss = 0.0
    for batch in batches:
        prediction = model(batch.scenes, resolution)
        share = view_losses(prediction, batch.target_BVRR3).sum() / num_views
        share.backward()
        loss += share.item()
    grad_norm = torch.nn.utils.clip_grad_norm_(model.parameters(), grad_clip)
    applied = bool(torch.isfinite(grad_norm)) and loss - loss == 0
    if applied:
        for group in optimizer.param_groups:
            group["lr"] = learning_rate
        optimizer.step()
    return StepReport(loss=loss, grad_norm=float(grad_norm), applied=applied)
