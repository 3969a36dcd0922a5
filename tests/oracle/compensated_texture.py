"""Multiple scattering for Mitsuba's `roughconductor`, as a texture of its specular reflectance.

The scale of storage.records.multiscatter depends on the direction of the viewer, which no stock
texture reads; one of our own may. `roughconductor` has the separable Smith term, so the table is
that one's: from every direction the surface returns as much light as in the kernel, but the shape
of a rough lobe differs (0.6 % of direct light at roughness 0.6, 4.5 % at 1, root mean square).
"""

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from storage.records.multiscatter import ROUGHNESS_STEPS, X_STEPS, albedo_table

PLUGIN = "compensated_specular"
"""Name in scene dictionaries; it has the textures specular, again (Fms) and alpha."""

_LEAST_COS = 1e-4
"""Only rays along the surface are below; the lookup divides by the cosine."""


@cache
def register_plugin() -> None:
    """Make PLUGIN known to Mitsuba; a variant must be set, and stays for the process."""

    class CompensatedSpecular(mi.Texture):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self._specular = properties.get_texture("specular")
            self._again = properties.get_texture("again")
            self._alpha = properties.get_texture("alpha")
            texels = mi.TensorXf(albedo_table("separable").astype(np.float32)[..., None])
            bilinear: Any = mi.Texture2f
            self._table = bilinear(texels, wrap_mode=dr.WrapMode.Clamp)

        def eval(self, si: Any, active: Any = True) -> Any:
            place = _place_in_table(si.wi.z, self._alpha.eval_1(si, active))
            albedo = self._table.eval(place)[0]
            more = self._again.eval(si, active) * ((1 - albedo) / albedo)
            return self._specular.eval(si, active) * (1 + more)

        def mean(self) -> Any:
            return self._specular.mean()

        def is_spatially_varying(self) -> bool:
            return True

    mi.register_texture(PLUGIN, CompensatedSpecular)


def _place_in_table(cosine: Any, alpha: Any) -> Any:
    cosine = dr.maximum(cosine, _LEAST_COS)
    cos_sq = cosine * cosine
    stretched = cosine * dr.rsqrt(cos_sq + alpha * alpha * (1 - cos_sq))
    # The centre of texel k of n lies at (k + 0.5) / n.
    u = (dr.sqrt(stretched) * (X_STEPS - 1) + 0.5) / X_STEPS
    v = (dr.sqrt(alpha) * (ROUGHNESS_STEPS - 1) + 0.5) / ROUGHNESS_STEPS
    return mi.Point2f(u, v)
