"""Materials with a Fresnel term, of other programs, as ours: two albedos, the same at every angle.

Files speak of Schlick's term, F0 + (F90 - F0)(1 - cos)^5. Our specular albedo is its mean over
cosine-weighted directions, F = F0 + (F90 - F0)/21, and the diffuse part gets what is left:
base (1 - metal)(1 - F). docs/explanation/material.md states what that costs at grazing angles.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

DIELECTRIC_F0 = 0.04
"""Typical reflectance of glass, plastic, wood and stone head-on."""

_MEAN_OF_SCHLICK = 1 / 21
"""Mean of (1 - cos)^5 over cosine-weighted directions: 2 B(2, 6)."""


def constant_albedos(
    base: NDArray[Any],
    metal: NDArray[Any],
    f0: NDArray[Any] | float = DIELECTRIC_F0,
    f90: NDArray[Any] | float = 1.0,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return diffuse and specular albedo; they add up to at most 1.

    `base` is linear color [..., 3], and `metal` the share [..., 1] that reflects it head-on. What
    is no metal reflects `f0` head-on and `f90` at grazing angles; both broadcast with `base`. All
    are from 0 to 1. Where nothing is metal the specular one knows nothing of `base`: its shape is
    that of the others, so that a texture of the base color leaves it one number.
    """
    head_on = (1 - metal) * f0
    if metal.any():
        head_on = np.clip(head_on + metal * base, 0, 1)
    grazing = (1 - metal) * f90 + metal
    specular = np.clip(head_on + (grazing - head_on) * _MEAN_OF_SCHLICK, 0, 1)
    return base * (1 - metal) * (1 - specular), specular
