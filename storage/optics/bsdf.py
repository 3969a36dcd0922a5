"""BSDF of a material as a mixture of two lobes: which share of the samples each gets.

An additive BRDF, diffuse d plus specular s, equals the blend (1 - w) * d/(1 - w) + w * s/w for any
w between 0 and 1. With w = max s / (max s + max d) both scaled albedos stay at most max s + max d,
hence at most 1, and the lobes are sampled in proportion to what they reflect.
"""

from dataclasses import dataclass

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
