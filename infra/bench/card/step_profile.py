"""Time of one step by part of the network, and by kind of kernel, from PyTorch's profiler."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import nn

from train.loss.lpips import Lpips
from train.loss.objective import Objective

MARK = "trilight: "
"""Before the names of parts in a trace."""
REST = "backward and rest"
DEAREST, NAME_CHARACTERS = 20, 100
"""Kernels that are listed by name, and how much of a name is kept."""

KINDS = (
    ("attention", r"attention|flash|fmha|mem_eff|sdpa"),
    ("optimiser", r"multi_tensor|foreach|fused_adam"),
    ("convolution", r"conv|wgrad|dgrad|winograd|cudnn"),
    ("product", r"gemm|cutlass|xmma|nvjet|cublas|matmul|aten::(addmm|mm|bmm|baddbmm)$"),
    ("norm", r"norm"),
    ("copy or cast", r"copy|memcpy|memset|cast|_to_|aten::(cat|stack|fill|zero)"),
    ("sum", r"reduce|softmax|aten::(sum|mean)"),
)
"""Kinds of kernels by what their names hold, the first that fits; all others are elementwise."""


@contextmanager
def marked_parts(model: nn.Module, objective: Objective, updater: Any) -> Iterator[None]:
    """Have the parts of a step stand in a trace; the optimiser is what `updater.step` does."""
    with ExitStack() as stack:
        for name, module in _parts(model, objective):
            stack.enter_context(_marked(name, module))
        step = updater.step

        def marked_step(*given: Any) -> Any:
            with torch.profiler.record_function(f"{MARK}optimiser"):
                return step(*given)

        updater.step = marked_step
        stack.callback(vars(updater).pop, "step")
        yield


def _parts(model: Any, objective: Objective) -> Iterator[tuple[str, nn.Module]]:
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
def _marked(name: str, module: Any) -> Iterator[None]:
    """Mark every call of a module, from outside: hooks would be a part of what is compiled."""
    before = module._compiled_call_impl  # what a call of a compiled module calls
    call = before or module._call_impl

    def marked_call(*given: Any, **named: Any) -> Any:
        with torch.profiler.record_function(MARK + name):
            return call(*given, **named)

    module._compiled_call_impl = marked_call
    try:
        yield
    finally:
        module._compiled_call_impl = before


def profiled(work: Callable[[], object], device: torch.device) -> dict[str, Any]:
    """Return the time of a call in ms by part and kind, its kernels, and the dearest of them.

    On a processor operators stand for kernels.
    """
    from torch.profiler import ProfilerActivity, profile

    on_card = device.type == "cuda"
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_card else [])]
    with profile(activities=activities) as trace:
        work()
        if on_card:
            torch.cuda.synchronize(device)
    events = trace.events() or []
    rows = [(event.name, _own_us(event)) for event in events if _is_kernel(event, on_card)]
    parts = Counter[str]()
    for event in events:
        if event.name.startswith(MARK) and not _is_on_card(event):
            part = event.name.removeprefix(MARK)
            parts[part] += event.device_time_total if on_card else event.cpu_time_total
    return summed(rows, parts)


def summed(rows: list[tuple[str, float]], parts: Counter[str]) -> dict[str, Any]:
    """Return the record of a profile.

    Args:
        rows: each kernel's name and microseconds.
        parts: microseconds of the marked parts; LPIPS stands within the loss.
    """
    kinds, names, counts = Counter[str](), Counter[str](), Counter[str]()
    for name, taken_us in rows:
        kinds[kind_of(name)] += taken_us  # type: ignore[assignment]
        names[name] += taken_us  # type: ignore[assignment]
        counts[name] += 1
    total_us = sum(kinds.values())
    parts = Counter(parts)
    if "LPIPS" in parts:
        parts["loss"] -= parts["LPIPS"]
    parts[REST] = max(total_us - sum(parts.values()), 0)
    return {
        "kernels": len(rows),
        "total_ms": total_us / 1e3,
        "by_part_ms": {name: taken_us / 1e3 for name, taken_us in parts.most_common()},
        "by_kind_ms": {name: taken_us / 1e3 for name, taken_us in kinds.most_common()},
        "dearest": [
            {"name": name[:NAME_CHARACTERS], "calls": counts[name], "ms": taken_us / 1e3}
            for name, taken_us in names.most_common(DEAREST)
        ],
    }


def kind_of(name: str) -> str:
    """Return what kind a kernel or an operator is, by its name."""
    found = (kind for kind, words in KINDS if re.search(words, name, re.IGNORECASE))
    return next(found, "elementwise")


def _is_on_card(event: Any) -> bool:
    return str(event.device_type).endswith("CUDA")


def _is_kernel(event: Any, on_card: bool) -> bool:
    if event.name.startswith(MARK) or getattr(event, "is_user_annotation", False):
        return False
    if on_card:
        return _is_on_card(event)
    return event.name.startswith("aten::") and event.self_cpu_time_total > 0


def _own_us(event: Any) -> float:
    on_card = _is_on_card(event)
    return float(event.self_device_time_total if on_card else event.self_cpu_time_total)
