"""BSDF of a material as a mixture of two lobes: which share of the samples each gets.

An additive BRDF, diffuse d plus specular s, equals the blend (1 - w) * d/(1 - w) + w * s/w for any
w between 0 and 1. With w = max s / (max s + max d) both scaled albedos stay at most max s + max d,
hence at most 1, and the lobes are sampled in proportion to what they reflect.

Materials of other programs have a Fresnel term; ours two albedos, the same at every angle. Files
speak of Schlick's term, F0 + (F90 - F0)(1 - cos)^5. Our specular albedo is its mean over
cosine-weighted directions, F = F0 + (F90 - F0)/21, and the diffuse part gets what is left:
base (1 - metal)(1 - F). docs/explanation/material.md states what that costs at grazing angles.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.conventions import alpha_ggx
from storage.records.material import DIFFUSE, ROUGHNESS, SPECULAR

MIN_ALPHA = 1e-4
"""Floor of the GGX width: a roughness of 0.01, the smoothest that scenes draw.

Below it float32 half vectors are too coarse to place the peak. A smaller roughness renders as 0.01.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lobes:
    """Materials of T triangles, ready for a renderer."""

    diffuse: NDArray[np.float64]
    """Diffuse albedo of each triangle [T, 3]."""
    specular: NDArray[np.float64]
    """Specular albedo of each triangle [T, 3]."""
    alpha: NDArray[np.float64]
    """[T] GGX width, at least MIN_ALPHA."""
    weight: NDArray[np.float64]
    """[T] share of the specular lobe, in [0, 1]; 0 for black."""


def bsdf_lobes(materials: NDArray[np.float32]) -> Lobes:
    """Return the lobes of material rows [T, 10 or more]; other columns are not read."""
    rows = materials.astype(np.float64)
    diffuse = rows[:, DIFFUSE]
    specular = rows[:, SPECULAR]
    d = diffuse.max(axis=1)
    s = specular.max(axis=1)
    weight = np.divide(s, s + d, out=np.zeros_like(s), where=s + d > 0)
    alpha = np.maximum(alpha_ggx(rows[:, ROUGHNESS]), MIN_ALPHA)
    return Lobes(diffuse=diffuse, specular=specular, alpha=alpha, weight=weight)


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
