"""What moves the weights: AdamW, and Muon for the matrices."""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from model.renderformer import RenderFormer
from model.width_scales import width_scales
from train.loop.decision import Decision, decides_late
from train.loop.muon import StackedMuon, muon
from train.settings import Precision, TrainSettings

ADAMW_KEEPS = ("exp_avg", "exp_avg_sq")
"""AdamW's state for each weight, beside its count of updates."""

MUON_KEEPS = ("momentum_buffer",)
"""Muon's state for each weight; it counts no updates."""

_SCALE = "width_scale"
"""Name in a group of weights of the factor of their rate."""

_Scaled = tuple[Tensor, float]
"""A weight, and the factor of its rate."""


class Updater:
    """Moves the weights of a network along its gradient: AdamW, and Muon for the matrices if asked.

    Muon (Jordan et al. 2024) makes the step of a matrix near orthogonal, so that its rare
    directions move as far as the frequent ones. Its steps are scaled to the size of AdamW's (Liu et
    al. 2025), so one learning rate serves both.

    How near two trainings come whose gradients differ by 1e-7 of themselves, as sums in another
    order do: with Muon's products in float32 a weight moves otherwise by up to 1e-5 of a typical
    step, with products in bfloat16, where such a difference can cross a rounding, by up to a tenth.
    """

    muon_precision: Precision | None
    """Precision of Muon's products; None where AdamW moves every weight."""

    def __init__(self, model: RenderFormer, settings: TrainSettings, precision: Precision) -> None:
        """Take the network, the run, and the precision of Muon's products (loop.muon)."""
        device = next(model.parameters()).device
        self._names: dict[Tensor, str] = {weight: name for name, weight in model.named_parameters()}
        scales = width_scales(model, settings.base_widths)
        matrices, others = list[_Scaled](), list[_Scaled]()
        for weight, name in self._names.items():
            if settings.muon_rate and _muon_takes(name, weight, settings):
                matrices.append((weight, scales[name].muon))
            else:
                others.append((weight, scales[name].adamw))
        adamw = torch.optim.AdamW(
            self._groups(others, settings),
            betas=settings.betas,
            fused=True if decides_late(device) else None,
        )
        self._optimizers: list[tuple[torch.optim.Optimizer, float]] = [(adamw, 1.0)]
        self.muon_precision = precision if matrices else None
        if matrices:
            thirds = [weight for weight, _ in matrices if _is_qkv(self._names[weight], settings)]
            groups = self._groups(matrices, settings)
            optimizer = muon(groups, settings.weight_decay, precision, thirds=thirds)
            self._optimizers.append((optimizer, settings.muon_rate))

    def _groups(self, weights: Sequence[_Scaled], settings: TrainSettings) -> list[dict[str, Any]]:
        """Return the groups of weights whose rates have one factor, and which decay or do not.

        A step takes the same share of every weight for decay, whatever that factor: a share that
        fell with the rate would keep wide networks from forgetting (Wortsman et al. 2023).
        """
        groups = defaultdict[tuple[float, float], list[Tensor]](list)
        for weight, scale in weights:
            decays = settings.decayed == "all" or _is_matrix(self._names[weight], weight)
            groups[scale, settings.weight_decay if decays else 0.0].append(weight)
        return [
            {"params": params, "weight_decay": decay / scale, _SCALE: scale}
            for (scale, decay), params in groups.items()
        ]

    def zero_grad(self) -> None:
        """Forget the gradient."""
        for optimizer, _ in self._optimizers:
            optimizer.zero_grad(set_to_none=True)

    def step(self, learning_rate: float, decision: Decision | None = None) -> None:
        """Move every weight along the gradient it holds, unless it is decided otherwise."""
        if decision is not None and decision.is_refused:
            return
        for optimizer, share in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * share * group[_SCALE]
            if isinstance(optimizer, StackedMuon):
                optimizer.decision = decision
            else:  # torch's name for it
                late = decision is not None and decision.is_late
                optimizer.found_inf = decision.refused if decision and late else None  # type: ignore[attr-defined]
            optimizer.step()

    def memories(self) -> dict[str, Tensor]:
        """Return the optimizers' state, by `kind/weight`; empty before the first update."""
        return {
            f"{kind}/{self._names[weight]}": memory[kind]
            for optimizer, _ in self._optimizers
            for weight, memory in optimizer.state.items()
            for kind in _kept(optimizer)
        }

    def remember(self, memories: Mapping[str, Tensor], updates: int) -> None:
        """Restore the state by `kind/weight`, saved after `updates` updates (1 or more)."""
        for optimizer, _ in self._optimizers:
            for weight in itertools.chain(*(group["params"] for group in optimizer.param_groups)):
                name = self._names[weight]
                memory = {
                    kind: memories[f"{kind}/{name}"].to(weight.device, copy=True)
                    for kind in _kept(optimizer)
                }
                if isinstance(optimizer, torch.optim.AdamW):
                    fused = optimizer.defaults["fused"]  # it counts on the card
                    memory["step"] = torch.tensor(
                        float(updates), device=weight.device if fused else None
                    )
                optimizer.state[weight] = memory


_TOKENS = "registers_NW"
"""End of the name of the learned tokens that come as a matrix, and are none."""

_LAYERS, _QKV = ".layers.", ".qkv.weight"
"""Parts of the names of the matrices of both stages' layers, and of those that hold three."""


def _is_matrix(name: str, weight: Tensor) -> bool:
    return weight.ndim > 1 and not name.endswith(_TOKENS)


def _muon_takes(name: str, weight: Tensor, settings: TrainSettings) -> bool:
    return weight.ndim == 2 and (settings.muon_takes == "matrices" or _LAYERS in name)


def _is_qkv(name: str, settings: TrainSettings) -> bool:
    return settings.muon_takes == "hidden" and name.endswith(_QKV)


def _kept(optimizer: torch.optim.Optimizer) -> tuple[str, ...]:
    return ADAMW_KEEPS if isinstance(optimizer, torch.optim.AdamW) else MUON_KEEPS
