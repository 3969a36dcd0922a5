"""Steps of a training preset on a device, with fewer scenes if memory is too small."""

import dataclasses
import gc
import statistics
import time
from collections.abc import Mapping
from typing import Any

import torch

from infra.bench.gpu.drawn_batch import drawn_batch, drawn_lpips, workloads
from infra.bench.gpu.probe import wait_for
from infra.bench.gpu.step_profile import marked_parts, profile_call
from model.config import ModelConfig, hits_smoke, smoke, tiny
from model.costs import training_flops
from train.loop.distributed import DistributedContext
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.objective import TrainingLoss
from train.runs import named_run
from train.settings import TrainSettings

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
    step_s = _step_s(step, steps, device)
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


def _step_s(step: Any, steps: int, device: torch.device) -> float:
    """Return the median seconds of a step, after warm-up steps."""
    times = []
    for _ in range(_WARM_STEPS + steps):
        began = time.perf_counter()
        step()
        wait_for(device)
        times.append(time.perf_counter() - began)
    return statistics.median(times[_WARM_STEPS:])
