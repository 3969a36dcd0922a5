"""Throughput of a device, and the steps of a training preset with their time by part.

Batches are synthetic, since the content does not change the time. Where memory is too small, a step
has fewer scenes. Times of parts are from PyTorch's profiler.
"""

import dataclasses
import gc
import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from infra.bench.workloads.cost_scene import cost_scene
from model.config import ModelConfig, hits_smoke, smoke, tiny
from model.costs import Workload, training_flops
from model.precision import fast_float32_products
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from pipeline.renders.mitsuba_variant import query_gpus
from storage.conventions import look_at_c2w
from train.data.buckets import TrainingBatch
from train.loop.distributed import DistributedContext
from train.loop.step import Stepper
from train.loop.train_state import new_state
from train.loss.lpips import BLOCKS, Lpips
from train.loss.training_loss import TrainingLoss
from train.presets import training_preset
from train.settings import TrainSettings

if TYPE_CHECKING:
    from model.config import ModelConfig

MARK = "trilight: "
"""Prefix of the names of parts in a trace."""
REST = "backward and rest"
SHRUNK_PX = 32
SHRUNK_TRIANGLES = 64
SHRUNK_SCENES = 2
THIN = (4, 8, 16, 16, 16)
"""Channels of LPIPS for shrunk presets."""

_WARM_STEPS = 3
_LIGHTS = 4
UNSTATED_TRIANGLES = 1024
"""Triangles of the longest scene if a preset sets no limit."""

SPREAD = 0.06
"""Fraction by which the shortest scene of a pass is shorter than the longest, as in the buckets of
`pretrain`. Half of it is padding on average, so that attention has a mask."""

VGG16_WIDTHS = (64, 128, 256, 512, 512)
"""Channels of VGG16's blocks, as in the published LPIPS."""

REPEATS = 5


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


def step_settings(run: str, device: torch.device) -> TrainSettings:
    """Return a preset with random initial weights; without a GPU a small one of its form."""
    settings = dataclasses.replace(training_preset(run), from_weights=False)
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


def workloads(settings: TrainSettings, scenes: int) -> list[Workload]:
    """Return the scenes of a pass, longest first."""
    longest = settings.most_triangles or UNSTATED_TRIANGLES
    return [
        Workload(
            triangles=round(longest * (1 - SPREAD * row / max(scenes - 1, 1))),
            views=settings.views_per_scene,
            resolution=settings.resolution,
        )
        for row in range(scenes)
    ]


def scene_of(workload: Workload) -> SceneTensors:
    """Return two objects in a room with an exact number of triangles, and cameras around them."""
    scene = cost_scene(math.ceil(1.3 * workload.triangles) + 32, _LIGHTS)
    poses = [
        look_at_c2w(
            eye=(1.4 + math.cos(6 * angle), math.sin(6 * angle) - 2.2, 1.3),
            target=(0, 0, 0.35),
            up=(0, 0, 1),
        )
        for angle in np.linspace(0, 1, workload.views, endpoint=False)
    ]
    tensors = scene_tensors(
        scene.with_cameras(
            np.stack(poses).astype(np.float32), np.full(workload.views, 40.0, np.float32)
        )
    )
    # rows spread over the scene, the room first and the lights last
    rows = torch.linspace(0, tensors.num_triangles - 1, workload.triangles).round().long()
    return SceneTensors(
        triangles_T33=tensors.triangles_T33[rows],
        normals_T33=tensors.normals_T33[rows],
        material_TM=tensors.material_TM[rows],
        c2w_V44=tensors.c2w_V44,
        fov_deg_V=tensors.fov_deg_V,
    )


def drawn_batch(settings: TrainSettings, scenes: int) -> TrainingBatch:
    """Return a batch on the processor: scenes of real geometry, with noise as targets."""
    generator = torch.Generator().manual_seed(0)
    views = settings.views_per_scene
    px = settings.resolution
    return TrainingBatch(
        scenes=batch_scenes(
            [_prepare(scene_of(each), settings.model, px) for each in workloads(settings, scenes)]
        ),
        target_BVRR3=0.3 * torch.rand(scenes, views, px, px, 3, generator=generator),
        noise_BV=torch.full((scenes, views), 1e-3),
    )


def _prepare(tensors: SceneTensors, model: "ModelConfig", px: int) -> SceneTensors:
    """Return a scene with the inputs of its network, as the stream does."""
    if not model.hit_rays:
        return tensors
    from model.demodulated import with_albedo
    from model.hits.tracing import with_traced

    if model.demodulated:
        return with_albedo(tensors, px, model.hit_rays)
    return with_traced(tensors, px, model, 0)


def drawn_lpips(settings: TrainSettings, widths: tuple[int, ...] = VGG16_WIDTHS) -> Lpips | None:
    """Return LPIPS with random weights of the published sizes; None if a preset has no LPIPS."""
    if settings.loss.perceptual != "lpips":
        return None
    vgg16 = {}
    linear = {}
    channels = 3
    generator = torch.Generator().manual_seed(0)
    for block, (numbers, width) in enumerate(zip(BLOCKS, widths, strict=True)):
        for number in numbers:
            spread = (2 / (9 * channels)) ** 0.5
            weight = spread * torch.randn(width, channels, 3, 3, generator=generator)
            vgg16[f"features.{number}.weight"] = weight
            vgg16[f"features.{number}.bias"] = torch.zeros(width)
            channels = width
        linear[f"lin{block}.model.1.weight"] = torch.rand(1, width, 1, 1, generator=generator)
    return Lpips(vgg16, linear)


def device_facts(device: torch.device) -> str:
    """Return a line on a device: memory, libraries, driver, without a serial number."""
    if device.type != "cuda":
        return f"no GPU: torch {torch.__version__} with {torch.get_num_threads()} threads"
    properties = torch.cuda.get_device_properties(device)
    driver = next(iter(query_gpus("driver_version")), "unknown")
    return (
        f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, torch {torch.__version__}, "
        f"CUDA {torch.version.cuda}, driver {driver}"
    )


def product_figures(device: torch.device, kind: str, width: int) -> dict[str, float]:
    """Return the seconds and FLOP/s of a large square matrix product: the best of five.

    Args:
        kind: float32, tf32, bfloat16 or float16.
    """
    dtype = torch.float32 if kind == "tf32" else getattr(torch, kind)
    matrix = torch.randn(width, width, device=device).to(dtype)
    with fast_float32_products(device, enabled=kind == "tf32"):
        seconds = min(time_calls(lambda: matrix @ matrix, device))
    return {"ms": 1e3 * seconds, "teraflop_per_s": 2 * width**3 / seconds / 1e12}


def copy_figures(device: torch.device, kind: str, size: int) -> dict[str, float]:
    """Return the seconds and bytes a second of a copy.

    Args:
        kind: within (bytes read and written count), to_pageable or to_pinned.
    """
    target = torch.zeros(size, dtype=torch.uint8, device=device)
    if kind == "within":
        source = torch.zeros(size, dtype=torch.uint8, device=device)
    else:
        source = torch.zeros(size, dtype=torch.uint8)
        source = source.pin_memory() if kind == "to_pinned" else source
    non_blocking = kind == "to_pinned"
    seconds = min(time_calls(lambda: target.copy_(source, non_blocking=non_blocking), device))
    moved = 2 * size if kind == "within" else size
    return {"ms": 1e3 * seconds, "gigabyte_per_s": moved / seconds / 1e9}


def time_calls(
    work: Callable[[], object], device: torch.device, repeats: int = REPEATS, *, warm_up: int = 1
) -> list[float]:
    """Return the seconds of several calls until the device is done, after some that warm it up."""
    times = []
    for _ in range(warm_up + repeats):
        began = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - began)
    return times[warm_up:]
