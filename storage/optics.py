"""Materials as numbers of light: lobes, Fresnel terms and multiple scattering.

An additive BRDF, diffuse d plus specular s, equals the blend (1 - w) * d/(1 - w) + w * s/w for any
w between 0 and 1. With w = max s / (max s + max d) both scaled albedos stay at most max s + max d,
hence at most 1, and the lobes are sampled in proportion to what they reflect.

Materials of other programs have a Fresnel term; ours two albedos, the same at every angle. Files
speak of Schlick's term, F0 + (F90 - F0)(1 - cos)^5. Our specular albedo is its mean over
cosine-weighted directions, F = F0 + (F90 - F0)/21, and the diffuse part gets what is left:
base (1 - metal)(1 - F). docs/explanation/material.md states what that costs at grazing angles.

A facet may send light to another facet. Single scattering loses that light: 59 % of it in a white
furnace at roughness 1. As Cycles does for its "Multiscatter GGX", the lobe is scaled so that it
returns what a random walk over the facets would (Turquin 2019, and Kulla and Conty 2017 for the
color). With E the directional albedo of a lobe that absorbs nothing, Eavg its cosine-weighted mean
over directions and F the specular albedo of a channel:

    scale = 1 + Fms (1 - E) / E        Fms = F Eavg / (1 - F (1 - Eavg))

The lobe then returns F (E + Fms (1 - E)) of the light: all for F = 1, less than F for a rough and
darker F, because each of the reflections absorbs. The scale knows the viewer's side only, so the
BRDF is not reciprocal; a path tracer from the camera does not mind.

E is tabulated over the cosine x of the *stretched* direction, x = c / sqrt(c^2 + (alpha s)^2) with
c and s cosine and sine: near grazing, E depends on x alone however smooth the surface is (it dips
to 0.89 at c = alpha), which a table over c itself would step over.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


Smith = Literal["correlated", "separable"]
"""Masking of both directions that depends on the same height of a facet (our kernel, as Cycles) or
not (Mitsuba's `roughconductor`, in the tests). Each needs a table of its own."""

X_STEPS = 64
ROUGHNESS_STEPS = 32
"""Size of the table, linear in sqrt(x) and in roughness = sqrt(alpha): exact to 0.25 % between."""

_INNER = 10
_OUTER = 8
"""Nodes over the slope of the facets, and over each half turn of their azimuth: exact to 3e-4."""

_SMALLEST_X = 1e-4
_SMALLEST_ALPHA = 1e-6
"""Values at which the table's entries at 0 are computed."""


def directional_albedo(
    stretched_cos: ArrayLike, alpha: ArrayLike, smith: Smith
) -> NDArray[np.float64]:
    """Return E of GGX.

    E = integral of D G2 (i.h) / (c_i c_h) over D-weighted facets h, of which those count that
    reflect to above the surface: for each azimuth the slopes up to a known bound, so that the
    integrand is smooth where quadrature needs it.

    Args:
        stretched_cos: x, in (0, 1].
        alpha: GGX width, in (0, 1]; broadcast against x.
        smith: how the masking of both directions comes together.

    Returns:
        E, of the shape that both broadcast to.
    """
    x, width = (np.asarray(a, np.float64)[..., None, None] for a in (stretched_cos, alpha))
    length = np.sqrt(1 - x**2 + np.square(width * x))
    cos_in = width * x / length
    sin_in = np.sqrt(1 - x**2) / length
    azimuth, azimuth_weight = _clustered_quadrature(_OUTER)
    cos_azimuth = np.sin(0.5 * np.pi * azimuth)[:, None]
    share = np.zeros(np.broadcast_shapes(x.shape, width.shape)[:-2])
    for side in (1, -1):  # facets that lean towards the viewer, and away
        along = side * sin_in * cos_azimuth
        steepest = (along + np.sqrt(along**2 + cos_in**2)) / cos_in
        # tan(facet) = alpha tan(psi) draws facets by D: their share is sin^2(psi).
        last = np.arctan2(steepest, width)
        node, weight = _clustered_quadrature(_INNER)
        psi = last * (1 - node)
        slope = width * np.tan(psi)
        projected = along * slope + cos_in
        cos_out = np.maximum(2 * projected / (1 + slope**2) - cos_in, 1e-12)
        masked_in = (1 / x - 1) / 2
        masked_out = (np.sqrt(1 + np.square(width) * (1 / cos_out**2 - 1)) - 1) / 2
        both = masked_in * masked_out if smith == "separable" else 0
        visible = projected / (cos_in * (1 + masked_in + masked_out + both))
        inner = (visible * last * np.sin(2 * psi) * weight).sum(axis=-1)
        share += 0.5 * (inner * azimuth_weight).sum(axis=-1)
    return share


@cache
def albedo_table(smith: Smith) -> NDArray[np.float64]:
    """Return E, [ROUGHNESS_STEPS, X_STEPS], from 0 to 1 in sqrt(x) and in roughness."""
    roughness = np.linspace(0, 1, ROUGHNESS_STEPS)[:, None]
    x = np.linspace(0, 1, X_STEPS) ** 2
    return directional_albedo(
        np.maximum(x, _SMALLEST_X), np.maximum(roughness**2, _SMALLEST_ALPHA), smith
    )


def scattered_again(
    specular: NDArray[np.float64], alpha: NDArray[np.float64], smith: Smith
) -> NDArray[np.float64]:
    """Return Fms [T, 3] of specular albedos [T, 3] and GGX widths [T]."""
    mean = mean_albedo(alpha, smith)[:, None]
    return specular * mean / (1 - specular * (1 - mean))


def mean_albedo(alpha: NDArray[np.float64], smith: Smith) -> NDArray[np.float64]:
    """Return Eavg = 2 * integral of c E dc for each alpha, from 32 roughnesses between 0 and 1."""
    roughness, means = _mean_albedos(smith)
    return np.interp(np.sqrt(alpha), roughness, means)


@cache
def _mean_albedos(smith: Smith) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    roughness = np.linspace(0, 1, ROUGHNESS_STEPS)
    alpha = np.maximum(roughness[:, None] ** 2, _SMALLEST_ALPHA)
    cosine, weight = _gauss_legendre(ROUGHNESS_STEPS)
    x = cosine / np.sqrt(cosine**2 + np.square(alpha) * (1 - cosine**2))
    return roughness, 2 * (directional_albedo(x, alpha, smith) * weight * cosine).sum(axis=1)


def _clustered_quadrature(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and weights over [0, 1], denser near 0: the squares of Gauss-Legendre's."""
    node, weight = _gauss_legendre(count)
    return node**2, 2 * node * weight


def _gauss_legendre(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and weights over [0, 1]."""
    node, weight = np.polynomial.legendre.leggauss(count)
    return (node + 1) / 2, weight / 2
