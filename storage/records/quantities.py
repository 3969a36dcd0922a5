"""The quantities of a scene that a report shows and a selection asks for, and their statistics."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Quantity(NamedTuple):
    """Something that is measured once or more in every scene."""

    label: str
    """Axis label with the unit."""
    digits: int
    """Decimals that documents and pages print."""
    per: Literal["scene", "object", "surface", "texture", "light", "sky", "view"]
    """Thing that has one value each; `surface` is an object, a floor or a wall."""


QUANTITIES: Mapping[str, Quantity] = {
    "objects_per_scene": Quantity("objects in a scene", 0, "scene"),
    "triangles_per_scene": Quantity("triangles of a scene", 0, "scene"),
    "triangles_per_object": Quantity("triangles of an object", 0, "object"),
    "diffuse": Quantity("diffuse albedo", 3, "surface"),
    "specular": Quantity("specular albedo", 3, "surface"),
    "albedo_sum": Quantity("diffuse + specular", 3, "surface"),
    "roughness": Quantity("roughness", 3, "surface"),
    "textures_per_scene": Quantity("textures in a scene", 0, "scene"),
    "texture_width": Quantity("width of a texture, texels", 0, "texture"),
    "lights_per_scene": Quantity("lights in a scene", 0, "scene"),
    "total_emission": Quantity("radiance, sum over the lights", 0, "scene"),
    "light_distance": Quantity("distance from the origin, m", 3, "light"),
    "light_size": Quantity("size (root of the area), m", 3, "light"),
    "skies_per_scene": Quantity("skies of a scene, 0 or 1", 0, "scene"),
    "sky_radiance": Quantity("mean radiance of a sky", 3, "sky"),
    "sky_peak": Quantity("brightest texel of a sky over its mean", 1, "sky"),
    "sky_half_light_deg": Quantity("angle with half of a sky's light, degrees", 1, "sky"),
    "camera_distance": Quantity("distance from the origin, m", 3, "view"),
    "elevation_deg": Quantity("elevation, degrees", 1, "view"),
    "azimuth_deg": Quantity("azimuth, degrees", 1, "view"),
    "fov_deg": Quantity("field of view, degrees", 1, "view"),
    "coverage": Quantity("share of the view on objects", 3, "view"),
    "noise_floor_db": Quantity("stated error, dB", 1, "view"),
    "noise_floor_linear_db": Quantity("stated error as linear PSNR, dB", 1, "view"),
    "object_noise_floor_db": Quantity("stated error over geometry, dB", 1, "view"),
    "expected_error_db": Quantity("expected error, dB", 1, "view"),
    "spp": Quantity("samples per pixel", 0, "view"),
    "camera_attempt": Quantity("cameras rejected before", 0, "view"),
}

STATISTICS = ("count", "min", "p5", "median", "mean", "p95", "max")


def summary(values: ArrayLike) -> dict[str, float]:
    """Return STATISTICS of the finite values; without any, only the count 0."""
    array = np.asarray(values, np.float64).ravel()
    finite = array[np.isfinite(array)]
    if not finite.size:
        return {"count": 0}
    low, median, high = np.percentile(finite, [5, 50, 95])
    values = (finite.min(), low, median, finite.mean(), high, finite.max())
    return {"count": finite.size, **dict(zip(STATISTICS[1:], map(float, values), strict=True))}
