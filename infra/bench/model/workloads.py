"""What is rendered in the benchmark of the network: scenes of any size, seen from all around."""

import math
from collections.abc import Mapping

import numpy as np
import torch

from infra.bench.renders.cost_scene import cost_scene
from model.costs import Workload
from model.scene_tensors import SceneTensors, scene_tensors
from storage.conventions import look_at_c2w

PUBLISHED_LENGTH = {256: 1572, 512: 4192}
"""Triangles that the published pipeline pads every scene to, by pixels across the picture."""

SCENES: Mapping[int, Mapping[str, int]] = {
    256: {"full": 1536, "median": 1434, "plane-only": 140},
    512: {"full": 4096, "median": 2462, "plane-only": 140},
}
"""Triangles by resolution; the median is that of 200 composed scenes of `pretrain-256` and of
`finetune-512`."""

VIEWS = (1, 4)

_LIGHTS = 4


def label(workload: Workload) -> str:
    """Return the name of a workload."""
    views = f"{workload.views} view{'s' if workload.views > 1 else ''}"
    return f"{workload.triangles} triangles, {views}, {workload.resolution} px"


def cases(resolution: int) -> dict[str, Workload]:
    """Return the compared workloads of a resolution by name."""
    return {
        f"{name}, {label(workload)}": workload
        for views in VIEWS
        for name, triangles in SCENES[resolution].items()
        for workload in [Workload(triangles=triangles, views=views, resolution=resolution)]
    }


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
