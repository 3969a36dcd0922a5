"""Symmetries of light that hold for an environment too: each returns another map of the same light.

A turn changes no texel; a mirror turns the order of columns, and so does no more than a turn.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from storage.records.environment import Environment

_FLIP = np.diag([1.0, -1.0, 1.0])
"""What reversed columns do: azimuths change their signs."""


def turned(sky: Environment, rotation_33: NDArray[np.float64]) -> Environment:
    """Return the sky after a rotation of the world."""
    rotation = rotation_33 @ sky.rotation.astype(np.float64)
    return dataclasses.replace(sky, rotation=rotation.astype(np.float32))


def behind_mirror(sky: Environment, sides_3: NDArray[np.float32]) -> Environment:
    """Return the sky behind a mirror, which turns the coordinates whose `sides` are -1: one of 3.

    Texels of reversed columns stand where the reflection puts them, to the last bit.
    """
    rotation = np.diag(sides_3.astype(np.float64)) @ sky.rotation.astype(np.float64) @ _FLIP
    return dataclasses.replace(
        sky,
        radiance_rgb=np.ascontiguousarray(sky.radiance_rgb[:, ::-1]),
        rotation=rotation.astype(np.float32),
    )


def with_channels(sky: Environment, order: NDArray[np.integer]) -> Environment:
    """Return the sky with its colour channels in another order."""
    return dataclasses.replace(sky, radiance_rgb=np.ascontiguousarray(sky.radiance_rgb[..., order]))


def scaled(sky: Environment, factor: float) -> Environment:
    """Return the sky with all of its light `factor` times as strong."""
    return dataclasses.replace(sky, radiance_rgb=sky.radiance_rgb * np.float32(factor))
