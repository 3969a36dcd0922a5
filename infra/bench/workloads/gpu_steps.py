"""Throughput of a device, pictures by the built-in networks, and the steps of a training preset.

Pictures are compared with those of this machine's processor, which finds a GPU with wrong results
before any time is trusted.

Batches are synthetic, since the content does not change the time. Where memory is too small, a step
has fewer scenes. `trilight train --profile` says where the time of a step goes.
"""

import dataclasses
import gc
import math
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from infra.bench.workloads.named_scenes import cost_scene
from infra.render.run_render import orbit
from model.config import SIZES, ModelConfig
from model.costs import Workload, training_flops
from model.hits.tracing import with_traced
from model.inference import NeuralRenderer
from model.precision import fast_float32_products
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from pipeline.renders.mitsuba_variant import query_gpus
from storage.metrics import psnr_log_db
from storage.renderer import Camera
from train.data.buckets import TrainingBatch
from train.loop.distributed import DistributedContext
from train.loop.step import Stepper
from train.loop.train_state import new_state
from train.loss.training_loss import BLOCKS, Lpips, TrainingLoss
from train.presets import training_preset
from train.settings import TrainSettings

TRIANGLES = 400
LIGHTS = 4
PX = 64
MORE_VIEWS = 5


def picture_figures(network: str, precision: str, device: torch.device) -> dict[str, float]:
    """Return psnr_log_db of a network's picture to the processor's, and milliseconds of a view.

    Args:
        network: name of a built-in network.
        precision: name of a precision (model.precision); the processor's picture is in float32.
    """
    expected = _first_view(network, torch.device("cpu"), "float32")()
    view = _first_view(network, device, precision)
    picture = view()
    seconds = statistics.median(time_calls(view, device, MORE_VIEWS, warm_up=0))
    return {"ms": 1e3 * seconds, "db": psnr_log_db(picture, expected)}


def _first_view(
    network: str, device: torch.device, precision: str
) -> Callable[[], NDArray[np.float32]]:
    """Return a function that renders the first view of the scene, [R, R, 3]."""
    renderer = NeuralRenderer.load(network, device=str(device), precision=precision)
    scene = cost_scene(TRIANGLES, LIGHTS)
    prepared = renderer.prepare(scene)
    return lambda: renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), PX)


SHRUNK_PX = 32
SHRUNK_TRIANGLES = 64
SHRUNK_SCENES = 2
THIN = (4, 8, 16, 16, 16)
"""Channels of LPIPS for shrunk presets."""

_WARM_STEPS = 3
UNSTATED_TRIANGLES = 1024
"""Triangles of the longest scene if a preset sets no limit."""

SPREAD = 0.06
"""Fraction by which the shortest scene of a pass is shorter than the longest, as in the buckets of
`pretrain`. Half of it is padding on average, so that attention has a mask."""

VGG16_WIDTHS = (64, 128, 256, 512, 512)
"""Channels of VGG16's blocks, as in the published LPIPS."""

REPEATS = 5


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
        return dataclasses.replace(SIZES["hits-smoke"](), scene_tokens=model.scene_tokens)
    return SIZES["tiny" if model.head == "dpt" else "smoke"]()


def step_figures(run: str, steps: int, device: torch.device) -> dict[str, float]:
    """Return figures of a step of one pass.

    A pass has as many scenes as in the preset, or as fit into memory. A preset that fails has no
    `ms`, so that the others are still measured.
    """
    settings = step_settings(run, device)
    scenes = min(settings.scenes_per_pass, settings.scenes_per_step)
    while scenes:
        try:
            figures = _measure_steps(settings, scenes, steps, device)
            if device.type == "cuda" and settings.compile == "auto":
                _free_memory()
                plain = dataclasses.replace(settings, compile="no")
                figures["plain_ms"] = _measure_steps(plain, scenes, steps, device)["ms"]
            return figures
        except torch.OutOfMemoryError:
            scenes //= 2
        finally:
            _free_memory()
    return {}


def _free_memory() -> None:
    gc.collect()
    torch.cuda.empty_cache()  # nothing happens where CUDA was not used


def _measure_steps(
    settings: TrainSettings, scenes: int, steps: int, device: torch.device
) -> dict[str, float]:
    state = new_state(settings, device)
    lpips = drawn_lpips(settings) if device.type == "cuda" else drawn_lpips(settings, THIN)
    objective = TrainingLoss(settings.loss, lpips).to(device)
    stepper = Stepper(state, objective, DistributedContext(device=device))
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
    return figures


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
    scene = cost_scene(math.ceil(1.3 * workload.triangles) + 32, LIGHTS)
    cameras = orbit(scene, Camera.of_scene(scene, 0), workload.views, arc_deg=60)
    c2w = np.stack([camera.c2w for camera in cameras])
    tensors = scene_tensors(scene.with_cameras(c2w, scene.fov_deg.repeat(len(cameras))))
    # rows spread over the scene, the room first and the lights last
    rows = torch.linspace(0, tensors.num_triangles - 1, workload.triangles).round().long()
    return dataclasses.replace(
        tensors,
        triangles_T33=tensors.triangles_T33[rows],
        normals_T33=tensors.normals_T33[rows],
        material_TM=tensors.material_TM[rows],
    )


def drawn_batch(settings: TrainSettings, scenes: int) -> TrainingBatch:
    """Return a batch on the processor: scenes of real geometry, with noise as targets."""
    generator = torch.Generator().manual_seed(0)
    views = settings.views_per_scene
    px = settings.resolution
    passed = [scene_of(each) for each in workloads(settings, scenes)]
    return TrainingBatch(
        scenes=batch_scenes([with_traced(each, px, settings.model) for each in passed]),
        target_BVRR3=0.3 * torch.rand(scenes, views, px, px, 3, generator=generator),
        noise_BV=torch.full((scenes, views), 1e-3),
    )


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
