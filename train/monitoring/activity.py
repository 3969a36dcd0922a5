"""Measurements within a step: time by phase, and norms by layer once a window."""

import math
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

PHASES = {
    "data": "waiting for data",
    "forward": "forward pass and loss",
    "backward": "backward pass",
    "device": "waiting for the device",
    "exchange": "exchange with the other processes",
    "optimiser": "clipping and moving the weights",
    "validation": "validation",
    "saving": "saving a checkpoint",
    "other": "batching, counting and writing the log",
}
"""Description of each phase of training, by name."""


@dataclass(frozen=True)
class ActivePhase:
    """Phase in progress."""

    phase: str
    """Name of the phase, one of PHASES."""
    since_s: float
    """Start of the phase, by time.monotonic()."""


class Activity:
    """Timer of phases: each moment belongs to exactly one.

    It measures host time, and never waits for a device. On a CPU a phase is the time of its work. A
    GPU works asynchronously: `forward` and `backward` are then the time to enqueue kernels, and
    their work appears as `device`, where the host first waits for a result (with several processes
    also as `exchange`). `data` and `saving` mean the same everywhere.

    Another thread may read `now` at any time.
    """

    def __init__(self) -> None:
        self.now = ActivePhase("other", time.monotonic())
        self._taken_s = dict.fromkeys(PHASES, 0.0)

    def begin(self, phase: str) -> None:
        """End the current phase, and begin another."""
        moment_s = time.monotonic()
        before = self.now
        self._taken_s[before.phase] += moment_s - before.since_s
        self.now = ActivePhase(phase, moment_s)

    @contextmanager
    def during(self, phase: str) -> Iterator[None]:
        """Assign the time of a block to a phase, then return to the previous one."""
        before = self.now.phase
        self.begin(phase)
        try:
            yield
        finally:
            self.begin(before)

    def working_seconds(self) -> float:
        """Return the seconds, above 0, since `pop_seconds` without validations and checkpoints."""
        self.begin(self.now.phase)
        pauses_s = self._taken_s["validation"] + self._taken_s["saving"]
        return max(sum(self._taken_s.values()) - pauses_s, 1e-9)

    def pop_seconds(self) -> dict[str, float]:
        """Return the seconds of each phase since the last call, and reset them."""
        self.begin(self.now.phase)
        taken_s = self._taken_s
        self._taken_s = dict.fromkeys(PHASES, 0.0)
        return taken_s


_GROUP = re.compile(r"[^.]+(\.[^.]+(\.\d+)?)?")
_DIGITS = 4


class LayerNorms:
    """Norms of one expected update; other updates cost nothing.

    The weights are copied during that update, after the activations were freed, so that peak memory
    does not rise. The norms stay on the device until the row of the log asks for them.
    """

    def __init__(self, model: nn.Module) -> None:
        self._groups: dict[str, list[nn.Parameter]] = {}
        for name, weight in model.named_parameters():
            self._groups.setdefault(layer_of(name), []).append(weight)
        self.expect_update(False)

    def expect_update(self, due: bool) -> None:
        """Set whether the next update is measured."""
        self._due = due
        self._grads: list[Tensor] = []
        self._before: list[list[Tensor]] = []
        self._norms: Tensor | None = None

    @torch.no_grad()
    def record_gradients(self) -> None:
        """Record the gradient norms; call when gradients are complete and not clipped yet."""
        if not self._due:
            return
        for weights in self._groups.values():
            self._grads.append(_length([w.grad for w in weights if w.grad is not None], weights))
            self._before.append([weight.clone() for weight in weights])

    @torch.no_grad()
    def record_update(self) -> None:
        """Record weight and update norms after the update, without a wait for the device."""
        columns = []
        for grad, weights, before in zip(
            self._grads, self._groups.values(), self._before, strict=False
        ):
            length = _length(before, weights)
            moved = [weight - old for weight, old in zip(weights, before, strict=True)]
            ratio = _length(moved, weights) / length.clamp(min=torch.finfo(length.dtype).tiny)
            columns.append(torch.stack([grad, length, ratio]))
        if columns:
            self.expect_update(False)
            self._norms = torch.stack(columns)

    def pop_row(self) -> dict[str, list[float | None]]:
        """Return LAYER_COLUMNS by layer of the measured update once; empty if there is none.

        It waits for the device. A number that is not finite is None.
        """
        if self._norms is None:
            return {}
        rows = self._norms.tolist()
        self.expect_update(False)
        return {
            layer: [float(f"{each:.{_DIGITS}g}") if math.isfinite(each) else None for each in row]
            for layer, row in zip(self._groups, rows, strict=True)
        }


def layer_of(parameter: str) -> str:
    """Return the layer of a parameter, such as `encoder.layers.3` or `decoder.head`."""
    match = _GROUP.match(parameter)
    assert match is not None
    return match[0]


def _length(tensors: Sequence[Tensor], like: Sequence[Tensor]) -> Tensor:
    if not tensors:
        return torch.zeros((), device=like[0].device)
    return nn.utils.get_total_norm(tensors)
