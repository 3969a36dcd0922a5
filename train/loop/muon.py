"""Muon in float32, for processors without bfloat16 products, and which processors those are."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from train.loop.crew import Crew
from train.settings import Precision


def fitting_precision(crew: Crew) -> Precision:
    """Return the precision of Muon's products that all processes of a crew are quick at.

    bfloat16 on a card and where the processor has AVX512_BF16, as all with AMX do. Elsewhere such a
    product is emulated: with AVX2 alone a step takes 12 times as long as in float32
    (docs/log/2026-11-24-muon.md). torch's own question, `_is_mkldnn_bf16_supported`, also says yes
    where AVX-512 emulates it. One answer for all, since every process moves its copy of the weights
    itself, and copies must not drift apart. All processes must call it.
    """
    quick = crew.device.type != "cpu" or torch.cpu._is_avx512_bf16_supported()
    return "float32" if crew.any(not quick) else "bfloat16"


def muon(
    matrices: Iterable[Tensor] | Iterable[dict[str, Any]], weight_decay: float, precision: Precision
) -> torch.optim.Muon:
    """Return the optimizer of matrices [M, N]: torch's own, or the same with float32 products.

    `matrices` may be groups of them, as torch's optimizers take those, each with its own decay.
    """
    kind = torch.optim.Muon if precision == "bfloat16" else Float32Muon
    return kind(matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")


class Float32Muon(torch.optim.Muon):
    """torch's Muon with products in float32, and the matrices of one shape in one product.

    Settings, state and update are those of torch.optim.Muon with `match_rms_adamw`; what differs is
    rounding. Stacks cost memory for a moment: five times that of all the matrices of one shape.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move every matrix along the gradient it holds; one without a gradient stays."""
        for group in self.param_groups:
            by_shape = defaultdict[torch.Size, list[Tensor]](list)
            for weight in group["params"]:
                if weight.grad is not None:
                    by_shape[weight.shape].append(weight)
            for weights in by_shape.values():
                self._move(weights, group)

    def _move(self, weights: Sequence[Tensor], group: Mapping[str, Any]) -> None:
        """Move matrices of one shape [M, N]."""
        wanted_SMN = torch.stack([self._wanted(weight, group["momentum"]) for weight in weights])
        steps_SMN = orthogonal(
            wanted_SMN, group["ns_coefficients"], group["ns_steps"], group["eps"]
        )
        # Liu et al. 2025: as long as a typical step of AdamW, whatever the shape
        rate = group["lr"] * 0.2 * math.sqrt(max(weights[0].shape))
        for weight, step_MN in zip(weights, steps_SMN, strict=True):
            weight.mul_(1 - group["lr"] * group["weight_decay"])
            weight.add_(step_MN, alpha=-rate)

    def _wanted(self, weight: Tensor, momentum: float) -> Tensor:
        """Return the gradient [M, N] with Nesterov's momentum, and remember it."""
        gradient = weight.grad
        assert gradient is not None
        memory = self.state[weight]
        if "momentum_buffer" not in memory:
            memory["momentum_buffer"] = torch.zeros_like(gradient)
        mean: Tensor = memory["momentum_buffer"]
        mean.lerp_(gradient, 1 - momentum)
        return gradient.lerp(mean, momentum)


def orthogonal(
    matrices_SMN: Tensor, coefficients: tuple[float, float, float], steps: int, eps: float
) -> Tensor:
    """Return matrices [S, M, N] with the same directions, and singular values about 1.

    Each of the `steps` turns every singular value s, of a matrix of length 1, into
    a s + b s^3 + c s^5 (Newton and Schulz's iteration with Jordan's coefficients, Jordan et al.
    2024). A matrix shorter than `eps` stays short, so zeros stay zeros.
    """
    a, b, c = coefficients
    tall = matrices_SMN.shape[1] > matrices_SMN.shape[2]
    x = matrices_SMN.mT if tall else matrices_SMN  # the smaller side makes the smaller product
    x = x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=eps)
    for _ in range(steps):
        square = x @ x.mT
        polynomial = torch.baddbmm(square, square, square, beta=b, alpha=c)
        x = torch.baddbmm(x, polynomial, x, beta=a)
    return x.mT if tall else x
