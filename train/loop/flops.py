"""What a step computes, and what this device can compute: both measured, neither guessed."""

import time
from functools import lru_cache

import torch
from torch.utils.flop_counter import FlopCounterMode

from model.config import ModelConfig
from model.renderformer import RenderFormer
from model.scene_tensors import SceneBatch

COUNTED_AT = (8, 16, 24)
"""Numbers of triangles at which is counted; any three would do."""

PEAK_WIDTH = {"cpu": 1024, "cuda": 8192}
"""Of the square product whose speed counts as the device's peak."""


PASSES = 3
"""Forward, and twice as much backward."""


class SceneFlops:
    """Floating point operations of one scene, forward and backward, by number of triangles.

    Attention is quadratic in the number of tokens and everything else linear, so that three counts
    say all. They are taken by torch's FlopCounter of the forward pass, on tensors without memory;
    the backward pass counts twice as much, one product for each operand.
    """

    def __init__(self, config: ModelConfig, *, num_views: int, resolution: int) -> None:
        with torch.device("meta"):
            model = RenderFormer(config)
        low, middle, high = (
            _counted(model, _empty_scene(count, num_views), resolution) for count in COUNTED_AT
        )
        step = COUNTED_AT[1] - COUNTED_AT[0]
        self._square = (high - 2 * middle + low) / (2 * step**2)
        self._linear = (middle - low) / step - self._square * (COUNTED_AT[0] + COUNTED_AT[1])
        self._constant = low - self._linear * COUNTED_AT[0] - self._square * COUNTED_AT[0] ** 2

    def __call__(self, num_triangles: int) -> float:
        """Return the operations of a scene; a multiplication with its addition counts as two."""
        return (self._square * num_triangles + self._linear) * num_triangles + self._constant


@lru_cache
def scene_flops(config: ModelConfig, num_views: int, resolution: int) -> SceneFlops:
    """Return the counts of a network, taken once in a process: they take seconds."""
    return SceneFlops(config, num_views=num_views, resolution=resolution)


@lru_cache
def device_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Return the operations per second of a large square product here: the best of five.

    It takes some milliseconds and then the measured value is remembered. Not the data sheet's
    figure, which no program reaches.
    """
    width = PEAK_WIDTH[device.type]
    matrix = torch.ones(width, width, dtype=dtype, device=device)
    best = float("inf")
    for _ in range(5):
        began = time.perf_counter()
        product = matrix @ matrix
        product[0, 0].item()  # waits until it is done
        best = min(best, time.perf_counter() - began)
    return 2 * width**3 / best


def _counted(model: RenderFormer, batch: SceneBatch, resolution: int) -> int:
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model(batch, resolution)
    return PASSES * int(counter.get_total_flops())


def _empty_scene(num_triangles: int, num_views: int) -> SceneBatch:
    def empty(*shape: int) -> torch.Tensor:
        return torch.zeros(1, *shape, device="meta")

    return SceneBatch(
        triangles_BT33=empty(num_triangles, 3, 3),
        normals_BT33=empty(num_triangles, 3, 3),
        material_BTM=empty(num_triangles, 10),
        c2w_BV44=empty(num_views, 4, 4),
        fov_deg_BV=empty(num_views),
        is_triangle_BT=None,
    )
