"""The quantities whose distributions a report shows, and how a distribution becomes numbers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """Something that is measured once or more in every scene."""

    label: str
    """For people, with the unit."""
    digits: int
    """Decimals that are shown."""


def _quantity(label: str, digits: int) -> Quantity:
    return Quantity(label=label, digits=digits)


QUANTITIES: Mapping[str, Quantity] = {
    "objects_per_scene": _quantity("objects in a scene", 0),
    "triangles_per_scene": _quantity("triangles of a scene", 0),
    "triangles_per_object": _quantity("triangles of an object", 0),
    "diffuse": _quantity("diffuse albedo", 3),
    "specular": _quantity("specular albedo", 3),
    "albedo_sum": _quantity("diffuse + specular", 3),
    "roughness": _quantity("roughness", 3),
    "lights_per_scene": _quantity("lights in a scene", 0),
    "total_emission": _quantity("radiance, sum over the lights", 0),
    "light_distance": _quantity("distance from the origin, m", 3),
    "light_size": _quantity("size (root of the area), m", 3),
    "camera_distance": _quantity("distance from the origin, m", 3),
    "elevation_deg": _quantity("elevation, degrees", 1),
    "azimuth_deg": _quantity("azimuth, degrees", 1),
    "fov_deg": _quantity("field of view, degrees", 1),
    "coverage": _quantity("share of the view on objects", 3),
    "noise_floor_db": _quantity("noise floor, dB", 1),
    "object_noise_floor_db": _quantity("noise floor over geometry, dB", 1),
    "spp": _quantity("samples per pixel", 0),
    "camera_attempt": _quantity("cameras rejected before", 0),
}

STATISTICS = ("count", "min", "p5", "median", "mean", "p95", "max")


def summary(values: ArrayLike) -> dict[str, float]:
    """Return STATISTICS of the finite values; only the count where there is none."""
    array = np.asarray(values, np.float64).ravel()
    finite = array[np.isfinite(array)]
    if not finite.size:
        return {"count": 0}
    low, median, high = (float(value) for value in np.percentile(finite, [5, 50, 95]))
    return {
        "count": int(finite.size),
        "min": float(finite.min()),
        "p5": low,
        "median": median,
        "mean": float(finite.mean()),
        "p95": high,
        "max": float(finite.max()),
    }
