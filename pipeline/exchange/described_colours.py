"""The random colours of RenderFormer's scene files: the published numbers, in the order of faces.

The published converter seeds numpy's legacy Mersenne Twister and draws whole numbers, one triple
per group, in the order in which trimesh splits the shaded mesh. On flat meshes that is the order of
the faces, and colours are exactly the published ones. On smooth meshes trimesh has its own order,
and its own groups where an object has large flat parts; there our groups come in the order of their
first faces, and the same numbers may fall on other groups than published.

The numbers stand in the published tokens as linear albedos, and so they do here. (Its renders took
them through vertex colours that Blender decodes as sRGB: the same numbers meant darker surfaces
there, which we do not imitate.)
"""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.description import DescribedMaterial
from pipeline.scenes.shading import ShadedMesh


def colour_groups(mesh: ShadedMesh, material: DescribedMaterial) -> NDArray[np.int64]:
    """Return, for every triangle [T], which draw gives its colour.

    As published, a flat mesh shares no vertices, so that each of its triangles is a group of its
    own, whatever the type says.
    """
    if material.smooth_shading and material.random_diffuse_type == "per-shading-group":
        return mesh.groups
    return np.arange(len(mesh.faces))


def random_diffuse(seed: int, bound: float, count: int) -> NDArray[np.float64]:
    """Return `count` diffuse albedos [count, 3]: whole numbers below ceil(256 bound), over 255.

    Args:
        seed: of the legacy generator, 0 to 2^32 - 1. Seed 0 is an ordinary seed.
        bound: `random_diffuse_max`; a channel may exceed it by at most 1/255.
        count: how many colours.
    """
    generator = np.random.RandomState(seed)
    return generator.randint(0, max(1, math.ceil(256 * bound)), (count, 3)) / 255
