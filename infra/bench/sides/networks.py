"""The sides of the benchmark, with the same weights: the published forward pass, and ours.

Weights are random: none of Base's size are shipped, and neither seconds nor bytes depend on them.
Errors do; those of a trained network are measured by the experiment `trained-precision`. The last
layer is scaled so that pictures have the spread of rendered ones: an error in dB with peak 1 would
otherwise say what the weights happen to be. Scenes have any number of triangles, and are seen from
all around.
"""

import copy
import math
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import elu

from infra.bench.effort import Effort
from infra.bench.sides.published_network import published_forward, published_inputs
from infra.bench.subjects.cost_scene import cost_scene
from model.config import SIZES, ModelConfig, base
from model.costs import Workload, flops
from model.precision import set_precision
from model.published.config import PublishedConfig
from model.published.convert import from_published, to_published
from model.renderformer import ELU_ALPHA, RenderFormer
from model.scene_tensors import (
    Cameras,
    SceneBatch,
    SceneTensors,
    batch_scenes,
    converted,
    scene_tensors,
)
from storage.conventions import look_at_c2w, radiance_from_log10
from storage.metrics import psnr_log_db
from storage.records.material import material_columns, material_width

PUBLISHED_LENGTH = {256: 1572, 512: 4192}
"""Triangles that the published pipeline pads every scene to, by pixels across the picture."""

_LIGHTS = 4


def scene_of(workload: Workload) -> SceneTensors:
    """Return two objects in a room, of exactly so many triangles, and cameras around them."""
    scene = cost_scene(math.ceil(1.3 * workload.triangles) + 32, _LIGHTS)
    angles = np.linspace(0, 1, workload.views, endpoint=False)
    poses = [
        look_at_c2w(
            eye=(1.4 + math.cos(6 * a), math.sin(6 * a) - 2.2, 1.3),
            target=(0, 0, 0.35),
            up=(0, 0, 1),
        )
        for a in angles
    ]
    whole = scene_tensors(
        scene.with_cameras(
            np.stack(poses).astype(np.float32), np.full(workload.views, 40.0, np.float32)
        )
    )
    # rows spread over the scene, the room first and the lights last
    rows = torch.linspace(0, whole.num_triangles - 1, workload.triangles).round().long()
    return SceneTensors(
        triangles_T33=whole.triangles_T33[rows],
        normals_T33=whole.normals_T33[rows],
        material_TM=whole.material_TM[rows],
        c2w_V44=whole.c2w_V44,
        fov_deg_V=whole.fov_deg_V,
    )


def base_flops(triangles: int, views: int, px: int) -> int:
    """Return the FLOPs of Base for a scene of so many triangles and square views of `px` pixels."""
    workload = Workload(triangles=triangles, views=views, resolution=px)
    return sum(flops(base(), workload).values())


PUBLISHED, EQUAL, DEFAULT = "published", "float32", "bfloat16"
SIDES = (PUBLISHED, EQUAL, DEFAULT)

RENDERED_MEAN, RENDERED_STD = 0.09, 0.075
"""Mean and spread of log10(1 + radiance) of the 20 pictures in `tests/references`; peak 1."""

_PROBE_TRIANGLES, _PROBE_PX = 256, 64

CPU = torch.device("cpu")

_SHARES = (0.1, 1 / 3, 2 / 3, 1.0, 5 / 3, 8 / 3)
"""Shares of the effort's triangles at which the network is timed: 154 to 4096 triangles."""

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


@torch.inference_mode()
def timed_forward(forward: Forward, on: torch.device) -> tuple[Tensor, dict[str, float]]:
    """Return a picture and the processor's seconds; on CUDA all of its work is done then."""
    began = time.process_time()
    picture = forward()
    if on.type == "cuda":
        torch.cuda.synchronize(on)
    return picture, {"core_s": time.process_time() - began}


def log10_psnr_db(picture: Tensor, reference: Tensor) -> float:
    """Return psnr_log_db of two outputs, log10(1 + radiance) of any sign and one shape.

    Before the ELU, which would hide what is wrong in the dark.
    """
    a, b = (radiance_from_log10(one.double().numpy()) for one in (picture, reference))
    return psnr_log_db(a, b)


def published_like(log10_rgb: Tensor) -> Tensor:
    """Return our output as the published network gives it, behind the ELU."""
    return elu(log10_rgb, alpha=ELU_ALPHA)


def random_network(config: ModelConfig) -> RenderFormer:
    """Return a network with fresh weights, and a last layer that is not yet black."""
    generator = torch.Generator().manual_seed(0)
    model = RenderFormer(config)
    model.initialise(generator)
    nn.init.xavier_uniform_(model.decoder.head.last.weight, generator=generator)
    return model.eval()


def _probe_batch() -> SceneBatch:
    """Return a random scene in the nominal shell, always the same, and one camera before it."""
    generator = torch.Generator().manual_seed(0)
    centre = torch.rand(_PROBE_TRIANGLES, 1, 3, generator=generator) - 0.5
    normals = torch.randn(_PROBE_TRIANGLES, 3, 3, generator=generator)
    c2w_V44 = torch.eye(4)[None].clone()
    c2w_V44[0, 2, 3] = 2.0
    scene = SceneTensors(
        triangles_T33=centre + 0.1 * torch.randn(_PROBE_TRIANGLES, 3, 3, generator=generator),
        normals_T33=normals / normals.norm(dim=-1, keepdim=True),
        material_TM=torch.rand(_PROBE_TRIANGLES, material_width(), generator=generator),
        columns=tuple(column.name for column in material_columns()),
        c2w_V44=c2w_V44,
        fov_deg_V=torch.tensor([40.0]),
    )
    return batch_scenes([scene])


def bright_network(config: ModelConfig) -> RenderFormer:
    """Return a random network whose pictures are as bright and varied as rendered ones."""
    model = random_network(config)
    last = model.decoder.head.last
    assert last.bias is not None
    with torch.no_grad():
        picture = model(_probe_batch(), max(_PROBE_PX, config.picture_px))
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


def workload_of(effort: Effort, triangles: int | None = None) -> Workload:
    """Return the effort's scene and view, or one of other triangles."""
    return Workload(
        triangles=effort.network_triangles if triangles is None else triangles,
        views=1,
        resolution=effort.network_px,
    )


def forward_of(model: RenderFormer, workload: Workload) -> Forward:
    """Return a pass over a prepared scene: encoded, then decoded for its one view."""
    return _ours(model, scene_of(workload), workload.resolution)


def core_s_by_triangles(effort: Effort) -> dict[int, float]:
    """Return core-seconds of one pass by triangles; the smallest runs twice, to warm up."""
    model = bright_network(SIZES[effort.network]())
    sizes = [max(16, round(share * effort.network_triangles)) for share in _SHARES]
    timed_forward(forward_of(model, workload_of(effort, sizes[0])), CPU)
    found = {}
    for size in sizes:
        _, figures = timed_forward(forward_of(model, workload_of(effort, size)), CPU)
        found[size] = figures["core_s"]
    return found
