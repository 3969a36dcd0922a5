"""Symmetries of environment maps, for augmentation.

A rotation changes no texel; a mirror reverses the order of columns, and then is a rotation.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from storage.records.environment import Environment

_FLIP = np.diag([1.0, -1.0, 1.0])
"""Matrix of reversed columns, which negate azimuths."""


def rotate_sky(sky: Environment, rotation_33: NDArray[np.float64]) -> Environment:
    """Return the sky after a rotation of the world space."""
    rotation = rotation_33 @ sky.rotation.astype(np.float64)
    return dataclasses.replace(sky, rotation=rotation.astype(np.float32))


def mirror_sky(sky: Environment, sides_3: NDArray[np.float32]) -> Environment:
    """Return the mirrored sky; the one coordinate whose `sides` is -1 is negated.

    Texels of reversed columns are exactly where the reflection puts them.
    """
    rotation = np.diag(sides_3.astype(np.float64)) @ sky.rotation.astype(np.float64) @ _FLIP
    return dataclasses.replace(
        sky,
        radiance_rgb=np.ascontiguousarray(sky.radiance_rgb[:, ::-1]),
        rotation=rotation.astype(np.float32),
    )


def permute_sky_channels(sky: Environment, order: NDArray[np.integer]) -> Environment:
    """Return the sky with permuted color channels."""
    return dataclasses.replace(sky, radiance_rgb=np.ascontiguousarray(sky.radiance_rgb[..., order]))


def scale_sky(sky: Environment, factor: float) -> Environment:
    """Return the sky with its radiance multiplied by `factor`."""
    return dataclasses.replace(sky, radiance_rgb=sky.radiance_rgb * np.float32(factor))
