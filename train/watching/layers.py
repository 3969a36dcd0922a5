"""Gradient, weight and update of each layer, once a window: where a training goes wrong first."""

import math
import re
from collections.abc import Sequence

import torch
from torch import Tensor, nn

_GROUP = re.compile(r"[^.]+(\.[^.]+(\.\d+)?)?")
_DIGITS = 4


class LayerNorms:
    """Looks at one update when it is told to; at all others it does nothing.

    The weights are copied while one update is made, after the activations are gone, so the peak of
    memory stays where it was. The figures leave the device together, in one transfer.
    """

    def __init__(self, model: nn.Module) -> None:
        self._groups: dict[str, list[nn.Parameter]] = {}
        for name, weight in model.named_parameters():
            self._groups.setdefault(layer_of(name), []).append(weight)
        self._due = False
        self._grads: list[Tensor] = []
        self._before: list[list[Tensor]] = []

    def expect(self, due: bool) -> None:
        """Say whether the next update is to be looked at."""
        self._due = due
        self._grads, self._before = [], []

    @torch.no_grad()
    def gradients(self) -> None:
        """Look at the gradients; call when they are whole, before they are clipped."""
        if not self._due:
            return
        for weights in self._groups.values():
            self._grads.append(_length([w.grad for w in weights if w.grad is not None], weights))
            self._before.append([weight.clone() for weight in weights])

    @torch.no_grad()
    def row(self) -> dict[str, list[float | None]]:
        """Return LAYER_COLUMNS by layer after the update; empty where none was looked at.

        A figure that is not finite is None.
        """
        columns = []
        for grad, weights, before in zip(
            self._grads, self._groups.values(), self._before, strict=False
        ):
            length = _length(before, weights)
            moved = [weight - old for weight, old in zip(weights, before, strict=True)]
            ratio = _length(moved, weights) / length.clamp(min=torch.finfo(length.dtype).tiny)
            columns.append(torch.stack([grad, length, ratio]))
        self.expect(False)
        if not columns:
            return {}
        values = torch.stack(columns).tolist()
        return {
            layer: [_rounded(value) for value in row]
            for layer, row in zip(self._groups, values, strict=True)
        }


def layer_of(parameter: str) -> str:
    """Return the layer that a parameter counts to, such as `encoder.layers.3` or `decoder.head`."""
    found = _GROUP.match(parameter)
    assert found is not None
    return found[0]


def _length(tensors: Sequence[Tensor], beside: Sequence[Tensor]) -> Tensor:
    if not tensors:
        return torch.zeros((), device=beside[0].device)
    return nn.utils.get_total_norm(tensors)


def _rounded(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
