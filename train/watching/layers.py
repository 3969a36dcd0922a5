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
    memory stays where it was. The figures leave the device with those of the steps (loop.step).
    """

    def __init__(self, model: nn.Module) -> None:
        self._groups: dict[str, list[nn.Parameter]] = {}
        for name, weight in model.named_parameters():
            self._groups.setdefault(layer_of(name), []).append(weight)
        self.expect(False)

    def expect(self, due: bool) -> None:
        """Say whether the next update is to be looked at."""
        self._due = due
        self._grads: list[Tensor] = []
        self._before: list[list[Tensor]] = []
        self._unread: Tensor | None = None
        self._row: dict[str, list[float | None]] = {}

    @torch.no_grad()
    def gradients(self) -> None:
        """Look at the gradients; call when they are whole, before they are clipped."""
        if not self._due:
            return
        for weights in self._groups.values():
            self._grads.append(_length([w.grad for w in weights if w.grad is not None], weights))
            self._before.append([weight.clone() for weight in weights])

    @torch.no_grad()
    def updated(self) -> None:
        """Look at the weights; call after the update. Nobody waits."""
        columns = []
        for grad, weights, before in zip(
            self._grads, self._groups.values(), self._before, strict=False
        ):
            length = _length(before, weights)
            moved = [weight - old for weight, old in zip(weights, before, strict=True)]
            ratio = _length(moved, weights) / length.clamp(min=torch.finfo(length.dtype).tiny)
            columns.append(torch.stack([grad, length, ratio]))
        if columns:
            self.expect(False)
            self._unread = torch.stack(columns)

    def unread(self) -> Tensor | None:
        """Return what was seen, [layers, LAYER_COLUMNS] on the device; None: nothing new."""
        return self._unread

    def read(self, values: Sequence[float]) -> None:
        """Take the numbers of `unread`, one layer after the other."""
        width = len(values) // len(self._groups)
        rows = [values[width * row : width * (row + 1)] for row in range(len(self._groups))]
        self.expect(False)
        self._row = {
            layer: [_rounded(value) for value in row]
            for layer, row in zip(self._groups, rows, strict=True)
        }

    def row(self) -> dict[str, list[float | None]]:
        """Return LAYER_COLUMNS by layer of the update that was read; empty where none was.

        A figure that is not finite is None.
        """
        row, self._row = self._row, {}
        return row


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
