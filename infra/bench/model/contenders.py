"""The sides of the benchmark, with the same weights: the published forward pass, and ours.

Weights are random: none of Base's size are shipped, and neither seconds nor bytes depend on them.
Errors do; those of a trained network are measured by `precision_parts`. The last layer is scaled so
that pictures have the spread of rendered ones: an error in dB with peak 1 would otherwise say what
the weights happen to be.
"""

import copy
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import elu

from infra.bench.model.published_forward import published_forward, published_inputs
from infra.bench.model.workloads import PUBLISHED_LENGTH, scene_of
from model.config import ModelConfig
from model.costs import Workload
from model.layer_errors import probe_batch, random_network
from model.precision import set_precision
from model.published.config import PublishedConfig
from model.published.convert import from_published, to_published
from model.renderformer import ELU_ALPHA, RenderFormer
from model.scene_tensors import Cameras, SceneTensors, batch_scenes, converted

PUBLISHED, EQUAL, DEFAULT = "published", "float32", "bfloat16"
SIDES = (PUBLISHED, EQUAL, DEFAULT)

RENDERED_MEAN, RENDERED_STD = 0.09, 0.075
"""Of log10(1 + radiance) over the 20 reference pictures in `tests/references`; their peak is 1."""

_PROBE_PX = 64

Forward = Callable[[], Tensor]
"""Returns log10(1 + radiance) [V, R, R, 3] before the ELU; of the published one behind it."""


class Contenders:
    """The networks of some sides, ready on a device."""

    def __init__(
        self, config: PublishedConfig, sides: tuple[str, ...], device: torch.device
    ) -> None:
        self._config, self._device = config, device
        weights = to_published(bright_network(config.model), config.texture_patch)
        model = from_published(weights, config)
        self._weights = {}
        if PUBLISHED in sides:
            self._weights = {name: tensor.to(device) for name, tensor in weights.items()}
        self._models = {
            side: set_precision(copy.deepcopy(model).to(device), side)
            for side in sides
            if side != PUBLISHED
        }

    def prepared(self, side: str, workload: Workload) -> Forward:
        """Return the forward pass of a side; its inputs are on the device."""
        scene = scene_of(workload)
        if side == PUBLISHED:
            inputs = published_inputs(
                _moved(scene, self._device),
                padded=PUBLISHED_LENGTH.get(workload.resolution, workload.triangles),
                texture_patch=self._config.texture_patch,
            )
            return lambda: published_forward(
                self._weights, self._config, inputs, workload.resolution
            )
        return _ours(self._models[side], _moved(scene, self._device), workload.resolution)


def published_like(log10_rgb: Tensor) -> Tensor:
    """Return our output as the published network gives it, behind the ELU."""
    return elu(log10_rgb, alpha=ELU_ALPHA)


def bright_network(config: ModelConfig) -> RenderFormer:
    """Return a random network whose pictures are as bright and varied as rendered ones."""
    model = random_network(config)
    last = model.decoder.head.last
    assert last.bias is not None
    with torch.no_grad():
        picture = model(probe_batch(), max(_PROBE_PX, config.picture_px))
        scale = RENDERED_STD / picture.std()
        last.weight *= scale
        last.bias.copy_(RENDERED_MEAN - scale * picture.mean())
    return model


def _ours(model: RenderFormer, scene: SceneTensors, resolution: int) -> Forward:
    """Return our way: encoded once, no padding; on a CPU the views one by one."""
    batch = batch_scenes([scene])
    cameras = batch.cameras
    together = cameras.c2w_BV44.is_cuda
    views = [cameras] if together else [_view(cameras, view) for view in range(scene.num_views)]

    def forward() -> Tensor:
        encoded = model.encode(batch)
        pictures = [model.decode(encoded, view, resolution)[0] for view in views]
        return torch.cat(pictures)

    return forward


def _view(cameras: Cameras, view: int) -> Cameras:
    return Cameras(c2w_BV44=cameras.c2w_BV44[:, [view]], fov_deg_BV=cameras.fov_deg_BV[:, [view]])


def _moved(scene: SceneTensors, device: torch.device) -> SceneTensors:
    return converted(scene, lambda tensor: tensor.to(device))
