"""Time of one step by part of the network, from PyTorch's profiler."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import nn

from train.loss.lpips import Lpips
from train.loss.objective import TrainingLoss

MARK = "trilight: "
"""Prefix of the names of parts in a trace."""
REST = "backward and rest"


@contextmanager
def marked_parts(model: nn.Module, objective: TrainingLoss, updater: Any) -> Iterator[None]:
    """Mark the parts of a step in a trace; the optimizer is the call of `updater.step`."""
    with ExitStack() as stack:
        for name, module in _parts(model, objective):
            stack.enter_context(_mark_calls(name, module))
        step = updater.step

        def marked_step(*args: Any) -> Any:
            with torch.profiler.record_function(f"{MARK}optimiser"):
                return step(*args)

        updater.step = marked_step
        stack.callback(vars(updater).pop, "step")
        yield


def _parts(model: Any, objective: TrainingLoss) -> Iterator[tuple[str, nn.Module]]:
    if model.encoder is not None:
        yield "encoder", model.encoder
    for layer in model.decoder.layers:
        yield "decoder layers", layer
    yield "head", model.decoder.head
    yield "loss", objective
    for module in objective.modules():
        if isinstance(module, Lpips):
            yield "LPIPS", module


@contextmanager
def _mark_calls(name: str, module: Any) -> Iterator[None]:
    """Mark every call of a module from outside, because hooks would be compiled with it."""
    before = module._compiled_call_impl  # what a call of a compiled module calls
    call = before or module._call_impl

    def marked_call(*args: Any, **named: Any) -> Any:
        with torch.profiler.record_function(MARK + name):
            return call(*args, **named)

    module._compiled_call_impl = marked_call
    try:
        yield
    finally:
        module._compiled_call_impl = before


def profile_call(work: Callable[[], object], device: torch.device) -> tuple[int, dict[str, float]]:
    """Return the number of kernels of a call, and its milliseconds by part.

    On a processor operators are counted instead of kernels.
    """
    from torch.profiler import ProfilerActivity, profile

    on_gpu = device.type == "cuda"
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]
    with profile(activities=activities) as trace:
        work()
        if on_gpu:
            torch.cuda.synchronize(device)
    events = trace.events() or []
    kernels_us = [_kernel_us(event) for event in events if _is_kernel(event, on_gpu=on_gpu)]
    parts = Counter[str]()
    for event in events:
        if event.name.startswith(MARK) and not _is_on_gpu(event):
            part = event.name.removeprefix(MARK)
            parts[part] += event.device_time_total if on_gpu else event.cpu_time_total
    return len(kernels_us), parts_ms(sum(kernels_us), parts)


def parts_ms(total_us: float, parts: Mapping[str, float]) -> dict[str, float]:
    """Return milliseconds by part, largest first, with the REST; LPIPS is part of the loss."""
    microseconds = dict(parts)
    if "LPIPS" in microseconds:
        microseconds["loss"] -= microseconds["LPIPS"]
    microseconds[REST] = max(total_us - sum(microseconds.values()), 0)
    return {
        name: microseconds[name] / 1e3
        for name in sorted(microseconds, key=lambda name: -microseconds[name])
    }


def _is_on_gpu(event: Any) -> bool:
    return str(event.device_type).endswith("CUDA")


def _is_kernel(event: Any, *, on_gpu: bool) -> bool:
    if event.name.startswith(MARK) or getattr(event, "is_user_annotation", False):
        return False
    if on_gpu:
        return _is_on_gpu(event)
    return event.name.startswith("aten::") and event.self_cpu_time_total > 0


def _kernel_us(event: Any) -> float:
    on_gpu = _is_on_gpu(event)
    return float(event.self_device_time_total if on_gpu else event.self_cpu_time_total)
