"""A training step at the paper's sizes on CUDA: FLOP/s as a share of what the device could do.

Float32 weights under bfloat16 autocast, AdamW, nothing recomputed; a step is three forward passes
of work, as is usually counted.
"""

import time
from collections.abc import Callable, Mapping

import torch

from infra.bench.model.workloads import scene_of
from model.config import ModelConfig
from model.costs import Workload, flops
from model.layer_errors import random_network
from model.scene_tensors import SceneBatch, batch_scenes

TRAINING = "training step"
PAPER = Workload(triangles=1536, views=2, resolution=256)
"""Of each scene in the first stage (Zeng et al. 2025)."""
SCENES = 16
"""Of a step, on each device."""

DENSE_BFLOAT16_TFLOPS = {"H200": 989.0, "H100": 989.0, "A100": 312.0}
"""Peaks by a word of the device's name, as its maker states them, without sparsity."""


def peak_tflops(on: torch.device) -> float | None:
    """Return the device's dense bfloat16 peak, or None where it is not known."""
    name = torch.cuda.get_device_name(on) if on.type == "cuda" else ""
    return next((peak for word, peak in DENSE_BFLOAT16_TFLOPS.items() if word in name), None)


def training_step(
    config: ModelConfig,
    on: torch.device,
    *,
    workload: Workload = PAPER,
    scenes: int = SCENES,
) -> Callable[[], Mapping[str, float]]:
    """Return one step of a fresh network on the same scene many times over."""
    model = random_network(config).to(on).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4)
    batch = _batch(workload, scenes, on)
    gflop = 3e-9 * scenes * sum(flops(config, workload).values())

    def step() -> Mapping[str, float]:
        began = time.perf_counter()
        optimizer.zero_grad(set_to_none=True)
        with torch.autocast(on.type, torch.bfloat16):
            loss = model(batch, workload.resolution).float().abs().mean()
        loss.backward()
        optimizer.step()
        if on.type == "cuda":
            torch.cuda.synchronize(on)
        return {"gflop": gflop, "gflop_per_s": gflop / (time.perf_counter() - began)}

    return step


def _batch(workload: Workload, scenes: int, on: torch.device) -> SceneBatch:
    one = batch_scenes([scene_of(workload)] * scenes)
    return SceneBatch(
        triangles_BT33=one.triangles_BT33.to(on),
        normals_BT33=one.normals_BT33.to(on),
        material_BTM=one.material_BTM.to(on),
        c2w_BV44=one.c2w_BV44.to(on),
        fov_deg_BV=one.fov_deg_BV.to(on),
        is_triangle_BT=None,
    )
