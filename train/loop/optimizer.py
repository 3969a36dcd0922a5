"""Optimizers of a run: AdamW, and Muon for the matrices.

The learning rate and its warm-up (warmup) are in train.loop.schedule.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from model.renderformer import RenderFormer
from model.width_scales import width_scales
from train.loop.decision import Decision, defers_sync
from train.loop.muon import StackedMuon, muon
from train.settings import Precision, TrainSettings

ADAMW_KEEPS = ("exp_avg", "exp_avg_sq")
"""Names of AdamW's state tensors for each weight, without its count of updates."""

MUON_KEEPS = ("momentum_buffer",)
"""Names of Muon's state tensors for each weight; it counts no updates."""

_SCALE = "width_scale"
"""Key of an optimizer's parameter group that holds the factor of its rate."""

_Scaled = tuple[Tensor, float]
"""A weight, and the factor of its learning rate."""


class Updater:
    """Updates the weights of a network with AdamW, and the matrices with Muon if configured.

    Muon (Jordan et al. 2024) makes the step of a matrix nearly orthogonal, so that its rare
    directions move as far as the frequent ones. Its steps are scaled to the size of AdamW's (Liu et
    al. 2025), so that one learning rate serves both.

    Gradients that are summed in another order differ by about 1e-7 of themselves. With Muon's
    products in float32 this changes a weight's step by up to 1e-5 of a typical step; with products
    in bfloat16, where such a difference can cross a rounding, by up to a tenth.
    """

    muon_precision: Precision | None
    """Precision of Muon's products; None if AdamW updates every weight."""

    def __init__(self, model: RenderFormer, settings: TrainSettings, precision: Precision) -> None:
        """Create the optimizers; `precision` is that of Muon's products (loop.muon)."""
        device = next(model.parameters()).device
        self._names: dict[Tensor, str] = {weight: name for name, weight in model.named_parameters()}
        scales = width_scales(model, settings.base_widths)
        muon_weights = list[_Scaled]()
        adamw_weights = list[_Scaled]()
        for weight, name in self._names.items():
            is_taken = settings.muon_takes == "matrices" or _LAYERS in name
            if settings.muon_rate and weight.ndim == 2 and is_taken:
                muon_weights.append((weight, scales[name].muon))
            else:
                adamw_weights.append((weight, scales[name].adamw))
        adamw = torch.optim.AdamW(
            self._groups(adamw_weights, settings),
            betas=settings.betas,
            fused=True if defers_sync(device) else None,
        )
        self._optimizers: list[tuple[torch.optim.Optimizer, float]] = [(adamw, 1.0)]
        self.muon_precision = precision if muon_weights else None
        if muon_weights:
            by_thirds = settings.muon_takes == "hidden"
            names = self._names
            thirds = [w for w, _ in muon_weights if by_thirds and names[w].endswith(_QKV)]
            groups = self._groups(muon_weights, settings)
            optimizer = muon(groups, settings.weight_decay, precision, thirds=thirds)
            self._optimizers.append((optimizer, settings.muon_rate))

    def _groups(self, weights: Sequence[_Scaled], settings: TrainSettings) -> list[dict[str, Any]]:
        """Return parameter groups of equal rate factor and equal decay.

        The decay of a step is independent of the rate factor: decay that shrank with the rate would
        be too weak for wide networks (Wortsman et al. 2023).
        """
        groups = defaultdict[tuple[float, float], list[Tensor]](list)
        for weight, scale in weights:
            is_matrix = weight.ndim > 1 and not self._names[weight].endswith(_TOKENS)
            decays = settings.decayed == "all" or is_matrix
            groups[scale, settings.weight_decay if decays else 0.0].append(weight)
        return [
            {"params": params, "weight_decay": decay / scale, _SCALE: scale}
            for (scale, decay), params in groups.items()
        ]

    def zero_grad(self) -> None:
        """Clear the gradients."""
        for optimizer, _ in self._optimizers:
            optimizer.zero_grad(set_to_none=True)

    def step(self, learning_rate: float, decision: Decision | None = None) -> None:
        """Update every weight by its gradient, unless the decision skips the step."""
        if decision is not None and decision.is_skipped:
            return
        for optimizer, factor in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * factor * group[_SCALE]
            if isinstance(optimizer, StackedMuon):
                optimizer.decision = decision
            else:  # torch's name for it
                deferred = decision is not None and decision.defer_sync
                optimizer.found_inf = decision.skip_flag if decision and deferred else None  # type: ignore[attr-defined]
            optimizer.step()

    def optimizer_state(self) -> dict[str, Tensor]:
        """Return the state tensors by `kind/weight`; empty before the first update."""
        return {
            f"{kind}/{self._names[weight]}": memory[kind]
            for optimizer, _ in self._optimizers
            for weight, memory in optimizer.state.items()
            for kind in _state_names(optimizer)
        }

    def load_optimizer_state(self, tensors: Mapping[str, Tensor], updates: int) -> None:
        """Restore the state tensors, saved after `updates` updates (1 or more)."""
        for optimizer, _ in self._optimizers:
            for weight in itertools.chain(*(group["params"] for group in optimizer.param_groups)):
                name = self._names[weight]
                state = {
                    kind: tensors[f"{kind}/{name}"].to(weight.device, copy=True)
                    for kind in _state_names(optimizer)
                }
                if isinstance(optimizer, torch.optim.AdamW):
                    fused = optimizer.defaults["fused"]  # it counts on the GPU
                    state["step"] = torch.tensor(
                        float(updates), device=weight.device if fused else None
                    )
                optimizer.state[weight] = state


_TOKENS = "registers_NW"
"""Suffix of the learned tokens, which have the shape of a matrix but are vectors."""

_LAYERS = ".layers."
_QKV = ".qkv.weight"
"""Parts of weight names: all layers, and the stacked query, key and value matrices."""


def _state_names(optimizer: torch.optim.Optimizer) -> tuple[str, ...]:
    return ADAMW_KEEPS if isinstance(optimizer, torch.optim.AdamW) else MUON_KEEPS
