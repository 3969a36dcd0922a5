"""What is rendered in the benchmark of the network: scenes of any size, seen from all around."""

import math

import numpy as np
import torch

from infra.bench.subjects.cost_scene import cost_scene
from model.config import base
from model.costs import Workload, flops
from model.scene_tensors import SceneTensors, scene_tensors
from storage.conventions import look_at_c2w

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
