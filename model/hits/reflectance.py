"""The specular lobe at points: GGX without Fresnel, compensated for multiple scattering.

The arithmetic of pipeline.renders.ggx in numpy; tests hold the two beside each other.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from model.hits.lit_scene import LitScene, PerPoint, Points
from model.hits.vectors import Floats, dot, tangents, unit
from storage.optics.multiscatter import ROUGHNESS_STEPS, X_STEPS, albedo_table

_INV_PI = np.float32(1 / np.pi)
_LEAST_COSINE = np.float32(1e-4)


@dataclass(frozen=True, kw_only=True, eq=False)
class Gloss(PerPoint):
    """The specular lobes of P points, each as its viewer sees it."""

    color: Floats
    """[3, P] specular albedo times the scale that multiple scattering brings."""
    alpha: Floats
    """[P] GGX width, above 0 and at most 1."""
    cos_seen: Floats
    """[P] cosine between shading normal and viewer."""
    stretch_seen: Floats
    """[P] length of the viewer's direction on stretched facets."""
    faces: NDArray[np.bool_]
    """[P] True: the viewer is above the shading normal's horizon; below there is no lobe."""


def gloss_at(scene: LitScene, points: Points, least_alpha: Floats | None = None) -> Gloss:
    """Return the lobes of points, those that are narrower than `least_alpha` [P] widened to it."""
    alpha = scene.material_at(points, "alpha")
    if least_alpha is not None:
        alpha = np.maximum(alpha, least_alpha)
    cosine = dot(points.normal, points.to_viewer)
    seen = np.maximum(cosine, _LEAST_COSINE)
    stretch = stretched_length(seen, alpha)
    albedo = np.maximum(_albedo(scene, seen / stretch, alpha), np.float32(1e-3))
    lost = (1 - albedo) / albedo
    specular = scene.material_at(points, "specular")
    multiscatter = scene.material_at(points, "multiscatter")
    return Gloss(
        color=specular * (1 + multiscatter * lost),
        alpha=alpha,
        cos_seen=seen,
        stretch_seen=stretch,
        faces=cosine > _LEAST_COSINE,
    )


def stretched_length(cosine: Floats, alpha: Floats) -> Floats:
    """Return the length of (alpha sin, cos)."""
    square = cosine * cosine
    length: Floats = np.sqrt(square + alpha * alpha * (1 - square))
    return length


def lobe(
    gloss: Gloss, points: Points, to_light: Floats, cos_light: Floats
) -> tuple[Floats, Floats]:
    """Return D G2 / (4 cos_i cos_o) cos_o without color, and `sample_lobe`'s density, [P] each.

    Args:
        to_light: [3, P] unit vectors.
        cos_light: [P] their cosine with the shading normal; where it is not above 0 the lobe is 0.
    """
    half = unit(to_light + points.to_viewer)
    upright = dot(half, points.normal)
    squared = gloss.alpha * gloss.alpha
    # sin^2 + alpha^2 cos^2, with sin^2 from the part across: 1 - cos^2 cancels for a small alpha
    across = half - points.normal * upright
    denominator = dot(across, across) + squared * upright * upright
    distribution = _INV_PI * squared / np.maximum(denominator * denominator, np.float32(1e-30))
    above = np.maximum(cos_light, _LEAST_COSINE)
    masked = gloss.stretch_seen / gloss.cos_seen + stretched_length(above, gloss.alpha) / above
    value = distribution / (2 * gloss.cos_seen * masked)
    density = distribution / (2 * (gloss.cos_seen + gloss.stretch_seen))
    shines = gloss.faces & (cos_light > 0) & (dot(to_light, points.geometric_normal) > 0)
    return np.where(shines, value, np.float32(0)), density


def sample_lobe(gloss: Gloss, points: Points, u: Floats) -> tuple[Floats, Floats]:
    """Return directions [3, P] drawn by visible normals from u [2, P], and their weights [P].

    A weight is what the lobe sends along the direction, cosine included, over the density: G2 / G1.
    Spherical caps (Dupuy and Benyoub 2023).
    """
    first, second = tangents(points.normal, points.edge)
    seen = np.stack([dot(points.to_viewer, first), dot(points.to_viewer, second), gloss.cos_seen])
    wide = np.stack([gloss.alpha, gloss.alpha, np.ones_like(gloss.alpha)])
    bent = unit(seen * wide)
    height = 1 - u[1] * (1 + bent[2])
    radius = np.sqrt(np.maximum(1 - height * height, 0))
    angle = np.float32(2 * np.pi) * u[0]
    cap = np.stack([radius * np.cos(angle), radius * np.sin(angle), height]) + bent
    half = unit(cap * wide)
    local = half * (2 * dot(seen, half)) - seen
    cosine = local[2]
    above = np.maximum(cosine, _LEAST_COSINE)
    masked_seen = gloss.stretch_seen / gloss.cos_seen
    masked = stretched_length(above, gloss.alpha) / above
    direction = first * local[0] + second * local[1] + points.normal * local[2]
    goes = gloss.faces & (cosine > 0) & (dot(direction, points.geometric_normal) > 0)
    weight = (1 + masked_seen) / (masked_seen + masked)
    return direction, np.where(goes, weight, np.float32(0))


def _albedo(scene: LitScene, stretched_cosine: Floats, alpha: Floats) -> Floats:
    """Return the directional albedo [P] between the entries of the table."""
    table = scene.here(_table())
    u = np.sqrt(stretched_cosine) * np.float32(X_STEPS - 1)
    v = np.sqrt(alpha) * np.float32(ROUGHNESS_STEPS - 1)
    column = np.minimum(u.astype(np.int32), X_STEPS - 2)
    row = np.minimum(v.astype(np.int32), ROUGHNESS_STEPS - 2)
    u = u - column
    v = v - row
    at = row * X_STEPS + column
    low = table[at] * (1 - u) + table[at + 1] * u
    high = table[at + X_STEPS] * (1 - u) + table[at + X_STEPS + 1] * u
    between: Floats = low * (1 - v) + high * v
    return between


@cache
def _table() -> Floats:
    return albedo_table("correlated").astype(np.float32).ravel()
