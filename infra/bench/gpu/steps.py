"""Steps of a training preset on a device, and their time by part of the network.

Where memory is too small, a step has fewer scenes. Times of parts are from PyTorch's profiler.
"""

import dataclasses
import gc
import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import nn

from infra.bench.gpu.drawn_batch import drawn_batch, drawn_lpips, workloads
from infra.bench.gpu.probe import time_calls
from model.config import ModelConfig, hits_smoke, smoke, tiny
from model.costs import training_flops
from train.loop.distributed import DistributedContext
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.lpips import Lpips
from train.loss.objective import TrainingLoss
from train.runs import named_run
from train.settings import TrainSettings

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


SHRUNK_PX = 32
SHRUNK_TRIANGLES = 64
SHRUNK_SCENES = 2
THIN = (4, 8, 16, 16, 16)
"""Channels of LPIPS for shrunk presets."""
_WARM_STEPS = 3


def step_settings(run: str, device: torch.device) -> TrainSettings:
    """Return a preset with random initial weights; without a GPU a small one of its form."""
    settings = dataclasses.replace(named_run(run), from_weights=False)
    if device.type == "cuda":
        return settings
    return dataclasses.replace(
        settings,
        model=_small(settings.model),
        resolution=SHRUNK_PX,
        most_triangles=SHRUNK_TRIANGLES,
        scenes_per_step=SHRUNK_SCENES,
        scenes_per_pass=min(settings.scenes_per_pass, SHRUNK_SCENES),
        views_per_scene=min(settings.views_per_scene, 2),
    )


def _small(model: ModelConfig) -> ModelConfig:
    if model.view_stage == "hits":
        return dataclasses.replace(hits_smoke(), scene_tokens=model.scene_tokens)
    return tiny() if model.head == "dpt" else smoke()


def step_figures(
    run: str, steps: int, device: torch.device
) -> tuple[dict[str, float], Mapping[str, float]]:
    """Return figures of a step of one pass, and its milliseconds by part of the network.

    A pass has as many scenes as in the preset, or as fit into memory. A preset that fails has no
    `ms`, so that the others are still measured.
    """
    settings = step_settings(run, device)
    scenes = min(settings.scenes_per_pass, settings.scenes_per_step)
    while scenes:
        try:
            figures, parts = _measure_steps(settings, scenes, steps, device)
            if device.type == "cuda" and settings.compile == "auto":
                _free_memory(device)
                plain, _ = _measure_steps(
                    dataclasses.replace(settings, compile="no"), scenes, steps, device
                )
                figures["plain_ms"] = plain["ms"]
            return figures, parts
        except torch.OutOfMemoryError:
            scenes //= 2
        finally:
            _free_memory(device)
    return {}, {}


def _free_memory(device: torch.device) -> None:
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def _measure_steps(
    settings: TrainSettings, scenes: int, steps: int, device: torch.device
) -> tuple[dict[str, float], Mapping[str, float]]:
    state = new_state(settings, device)
    lpips = drawn_lpips(settings) if device.type == "cuda" else drawn_lpips(settings, THIN)
    objective = TrainingLoss(settings.loss, lpips).to(device)
    stepper = Stepper(state, settings, objective, DistributedContext(device=device))
    batch = drawn_batch(settings, scenes).to(device)  # a run sends the next while one is computed

    def step() -> None:
        stepper.step([batch], settings.learning_rate)
        state.step += 1

    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    step_s = statistics.median(time_calls(step, device, steps, warm_up=_WARM_STEPS))
    figures = {
        "ms": 1e3 * step_s,
        "scenes": float(scenes),
        "views_per_s": scenes * settings.views_per_scene / step_s,
        "teraflop_per_s": sum(
            training_flops(settings.model, each) for each in workloads(settings, scenes)
        )
        / step_s
        / 1e12,
    }
    if device.type == "cuda":
        figures["peak_gib"] = torch.cuda.max_memory_allocated(device) / 2**30
    with marked_parts(state.model, objective, state.updater):
        kernels, parts = profile_call(step, device)
    return {**figures, "kernels": float(kernels)}, parts
