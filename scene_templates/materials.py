"""Surfaces: the published sampling, in linear colour throughout.

The published pipeline passes colours through 8-bit vertex colours whose transfer curve differs
between its renderer and its tokens (reference: renderformer.md, G.3); a number here means the same
albedo everywhere.
"""

import math

import numpy as np

from scene_templates.layout import Surface
from scene_templates.settings import SceneSettings


def surface_rand(rng: np.random.Generator, settings: SceneSettings) -> Surface:
    """Draw a surface: mostly white energy split between a coloured diffuse and a grey specular."""
    albedo_sum = rng.uniform(*settings.albedo_sum)
    specular = albedo_sum * rng.random()
    diffuse_scale = albedo_sum - specular
    red, green, blue = diffuse_scale * rng.random(3)
    low, high = (math.log(bound) for bound in settings.roughness_log)
    roughness = math.exp(rng.uniform(low, high)) - settings.roughness_bias
    smooth = rng.random() < settings.smooth_share
    return Surface(
        diffuse_scale=diffuse_scale,
        diffuse_rgb=(red, green, blue),
        specular=specular,
        roughness=float(np.clip(roughness, *settings.roughness_clip)),
        smooth=smooth,
        coloured=smooth and rng.random() < settings.coloured_share,
    )
