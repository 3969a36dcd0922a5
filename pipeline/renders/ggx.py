"""The BRDF inside a kernel: Lambert plus GGX without Fresnel, single scattering.

    f = diffuse / pi + specular * D * G1(wi) * G1(wo) / (4 cos_i cos_o)

D and G1 are those of GGX (Walter et al. 2007) with the separable G of Mitsuba's `roughconductor`,
so that both tracers mean the same material. Single scattering loses light at high roughness (62 %
in a white furnace at roughness 1). Directions are in the shading frame, the normal is +z.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

_INV_PI = 0.3183098861837907


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelLobes:
    """The material of each lane, as Dr.Jit arrays."""

    diffuse: Any
    """Color3f."""
    specular: Any
    """Color3f."""
    alpha: Any
    """Float: GGX width."""
    weight: Any
    """Float: share of the specular lobe."""


def evaluate(lobes: KernelLobes, wi: Any, wo: Any) -> tuple[Any, Any]:
    """Return f * cos_o (Color3f) and the density with which `sample` draws wo (Float).

    Both are 0 unless both directions are above the surface.
    """
    above = (wi.z > 0) & (wo.z > 0)
    distribution = _distribution(dr.normalize(wi + wo), lobes.alpha)
    visible = distribution * _shadowing(wi, lobes.alpha) / (4 * wi.z)
    cosine = _INV_PI * wo.z
    reflected = lobes.diffuse * cosine + lobes.specular * (visible * _shadowing(wo, lobes.alpha))
    density = (1 - lobes.weight) * cosine + lobes.weight * visible
    return dr.select(above, reflected, 0), dr.select(above, density, 0)


def sample(lobes: KernelLobes, wi: Any, u_lobe: Any, u_direction: Any) -> Any:
    """Return a direction drawn from the mixture of cosine and visible normals (Vector3f)."""
    half = _visible_normal(wi, lobes.alpha, u_direction)
    mirrored = half * (2 * dr.dot(wi, half)) - wi
    scattered = mi.warp.square_to_cosine_hemisphere(u_direction)
    return dr.select(u_lobe < lobes.weight, mirrored, scattered)


def _distribution(half: Any, alpha: Any) -> Any:
    # sin^2 + alpha^2 cos^2 from x and y: (alpha^2 - 1) cos^2 + 1 cancels for a small alpha.
    spread = dr.square(half.x) + dr.square(half.y) + dr.square(alpha * half.z)
    return _INV_PI * dr.square(alpha / spread)


def _shadowing(direction: Any, alpha: Any) -> Any:
    tangent_sq = (dr.square(direction.x) + dr.square(direction.y)) / dr.square(direction.z)
    return 2 / (1 + dr.sqrt(1 + dr.square(alpha) * tangent_sq))


def _visible_normal(wi: Any, alpha: Any, u: Any) -> Any:
    """Spherical caps (Dupuy and Benyoub 2023): exact, and without a frame around wi."""
    stretched = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, wi.z))
    z = 1 - u.y * (1 + stretched.z)
    radius = dr.safe_sqrt(1 - z * z)
    sine, cosine = dr.sincos(2 * dr.pi * u.x)
    half = mi.Vector3f(radius * cosine, radius * sine, z) + stretched
    return dr.normalize(mi.Vector3f(alpha * half.x, alpha * half.y, half.z))
