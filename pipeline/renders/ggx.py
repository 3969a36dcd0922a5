"""The BSDF inside a kernel: Lambert plus GGX without Fresnel, with multiple scattering.

    f = diffuse / pi + scale * specular * D * G2 / (4 cos_i cos_o)

D is that of GGX and G2 the height-correlated Smith term (Heitz 2014), alpha = roughness^2; the
scale gives back what single scattering loses (storage.optics). This is the material
of Cycles with its "Multiscatter GGX" and a constant colour, and Mitsuba's `diffuse` and
`roughconductor` together, but for Fresnel. The diffuse lobe is reciprocal, the
specular one is not, because its scale depends on the viewer's side alone: a path from a light must
say which side that is. Directions are in the shading frame, the normal is +z.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pipeline.renders.device_memory import own_floats
from storage.optics import ROUGHNESS_STEPS, X_STEPS, albedo_table

INV_PI = 0.3183098861837907


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelLobes:
    """The material of each lane, as Dr.Jit arrays."""

    diffuse: Any
    """Albedo of the Lambert lobe, Color3f."""
    specular: Any
    """Albedo of the GGX lobe, Color3f; scaled by `seen_from`, it may exceed 1."""
    alpha: Any
    """GGX width, Float: the square of the roughness."""
    weight: Any
    """Probability of the specular lobe in a sample, Float."""
    multiscatter: Any
    """Multiple-scattering factor Fms (storage.optics), Color3f."""


class AlbedoLookup:
    """The table of storage.optics, for kernels.

    An entry holds its three upper neighbours too, so that a lane loads all four at once.
    """

    def __init__(self) -> None:
        table = albedo_table("correlated")
        padded = np.pad(table, ((0, 1), (0, 1)), mode="edge")
        corners = [padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]]
        self._rows = own_floats(np.stack(corners, axis=-1))

    def __call__(self, cos_in: Any, alpha: Any, active: Any) -> Any:
        """Return E (Float) of the direction whose cosine is `cos_in`; from below, that at 0."""
        cosine = dr.maximum(cos_in, 0)
        u = dr.sqrt(cosine / _stretch(cosine, alpha)) * (X_STEPS - 1)
        v = dr.sqrt(alpha) * (ROUGHNESS_STEPS - 1)
        # bounded: what is no number becomes another integer on each kind of processor
        column = dr.minimum(mi.UInt32(u), X_STEPS - 1)
        row = dr.minimum(mi.UInt32(v), ROUGHNESS_STEPS - 1)
        u = u - mi.Float(column)
        v = v - mi.Float(row)
        near = dr.gather(mi.Vector4f, self._rows, row * X_STEPS + column, active)
        return dr.lerp(dr.lerp(near.x, near.y, u), dr.lerp(near.z, near.w, u), v)


def seen_from(lobes: KernelLobes, wi: Any, albedo: Any) -> KernelLobes:
    """Return the lobes scaled for a viewer in direction `wi`, whose directional albedo is `albedo`.

    A shading normal may turn away from a viewer who sees the triangle's front: then the specular
    lobe is gone, as in Cycles.
    """
    scaled = lobes.specular * (1 + lobes.multiscatter * ((1 - albedo) / albedo))
    return replace(lobes, specular=scaled, weight=dr.select(wi.z > 0, lobes.weight, 0))


def evaluate_bsdf(
    lobes: KernelLobes, wi: Any, wo: Any, geometric: Any, unmapped: Any = None
) -> tuple[Any, Any]:
    """Return f * cos_o (Color3f) and the density with which `sample` draws wo (Float).

    Args:
        lobes: from `seen_from`.
        wi: Vector3f to the viewer.
        wo: Vector3f to the light; below the surface both results are 0.
        geometric: Vector3f, the triangle's own normal on the viewer's side. The specular lobe
            reflects nothing to below it, as in Cycles, whatever the shading normal says; `sample`
            still goes there, and the density counts it.
        unmapped: Vector3f, the normal before its map, below which neither lobe reflects, as with
            Mitsuba's `normalmap`; the density counts those directions too. None without a map.
    """
    facets = _distribution(dr.normalize(wi + wo), lobes.alpha) / (2 * wi.z)
    # 1 + 2 Lambda of Smith's term, so that G1 = 2 / (1 + m) and G2 = 2 / (m_i + m_o).
    masked_in = _stretch(wi.z, lobes.alpha) / wi.z
    masked_out = _stretch(wo.z, lobes.alpha) / wo.z
    mirrored = lobes.specular * (facets / (masked_in + masked_out))
    cosine = INV_PI * wo.z
    pdf = (1 - lobes.weight) * cosine + lobes.weight * facets / (1 + masked_in)
    reflected = lobes.diffuse * cosine + dr.select(dr.dot(wo, geometric) > 0, mirrored, 0)
    # A viewer below has no specular lobe: its terms are 0 times what may be infinite.
    faces = wi.z > 0
    above = wo.z > 0
    reflected = dr.select(faces, reflected, lobes.diffuse * cosine)
    pdf = dr.select(faces, pdf, cosine)
    if unmapped is not None:
        reflected = dr.select(dr.dot(wo, unmapped) > 0, reflected, 0)
    return dr.select(above, reflected, 0), dr.select(above, pdf, 0)


def reverse_pdf(lobes: KernelLobes, wi: Any, wo: Any, geometric: Any) -> Any:
    """Return the density with which `sample`, for a path that comes from wo, draws wi (Float).

    Such a path sees the surface from the side of wo. Where that is the triangle's other side, the
    shading normal is turned over, wo is then below it, and only the cosine is left.

    Args:
        lobes: from `seen_from` wi.
        wi: Vector3f to the viewer.
        wo: Vector3f to the light, above the shading normal: `evaluate_bsdf` is 0 elsewhere, and
            this means nothing there.
        geometric: as in `evaluate_bsdf`.
    """
    distribution = _distribution(dr.normalize(wi + wo), lobes.alpha)
    facets = distribution / (2 * (wo.z + _stretch(wo.z, lobes.alpha)))
    pdf = (1 - lobes.weight) * INV_PI * wi.z + lobes.weight * facets
    same_side = dr.dot(wo, geometric) > 0
    above = dr.select(same_side & (wi.z > 0), pdf, 0)
    return dr.select(same_side, above, INV_PI * dr.maximum(-wi.z, 0))


def sample(lobes: KernelLobes, wi: Any, u_lobe: Any, u_direction: Any) -> Any:
    """Return a direction drawn from the mixture of cosine and visible normals (Vector3f)."""
    half = _visible_normal(wi, lobes.alpha, u_direction)
    mirrored = half * (2 * dr.dot(wi, half)) - wi
    scattered = mi.warp.square_to_cosine_hemisphere(u_direction)
    return dr.select(u_lobe < lobes.weight, mirrored, scattered)


def _distribution(half: Any, alpha: Any) -> Any:
    # sin^2 + alpha^2 cos^2 from x and y: (alpha^2 - 1) cos^2 + 1 cancels for a small alpha.
    spread = dr.square(half.x) + dr.square(half.y) + dr.square(alpha * half.z)
    return INV_PI * dr.square(alpha / spread)


def _stretch(cosine: Any, alpha: Any) -> Any:
    """Return the length of (alpha sin, cos): what a direction measures on stretched facets."""
    cos_sq = dr.square(cosine)
    return dr.sqrt(cos_sq + dr.square(alpha) * (1 - cos_sq))


def _visible_normal(wi: Any, alpha: Any, u: Any) -> Any:
    """Spherical caps (Dupuy and Benyoub 2023): exact, and without a frame around wi."""
    stretched = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, wi.z))
    z = 1 - u.y * (1 + stretched.z)
    radius = dr.safe_sqrt(1 - z * z)
    sine, cosine = dr.sincos(2 * dr.pi * u.x)
    half = mi.Vector3f(radius * cosine, radius * sine, z) + stretched
    return dr.normalize(mi.Vector3f(alpha * half.x, alpha * half.y, half.z))
