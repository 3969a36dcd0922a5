"""`TexturedTable`: the table of a scene whose materials have textures.

What pipeline.renders.surface_table knows of a triangle in advance is found at each place here: the
shares of the lobes and their multiple scattering follow the values that the textures have there.
Scenes without textures have the other table, and with it another kernel.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats
from pipeline.renders.ggx import KernelLobes
from pipeline.renders.kernel_textures import KernelTextures
from pipeline.renders.surface_table import SurfaceTable
from storage.optics.bsdf import MIN_ALPHA
from storage.optics.multiscatter import ROUGHNESS_STEPS, mean_albedo
from storage.records.scene import Scene


class TexturedTable(SurfaceTable):
    """The triangles `order` of a textured scene, in that order."""

    def __init__(self, scene: Scene, order: NDArray[np.intp]) -> None:
        super().__init__(scene, order)
        self._textures = KernelTextures(scene, order)
        roughness = np.linspace(0, 1, ROUGHNESS_STEPS)
        self._mean_albedo = own_floats(mean_albedo(np.square(roughness), "correlated"))

    def shading(self, triangle: Any, barycentric: Any, active: Any) -> tuple[Any, KernelLobes]:
        normal, lobes = super().shading(triangle, barycentric, active)
        columns = lobes.diffuse, lobes.specular, dr.sqrt(lobes.alpha)
        diffuse, specular, roughness = self._textures.values(triangle, barycentric, columns, active)
        alpha = dr.maximum(dr.square(roughness), MIN_ALPHA)
        most = dr.max(diffuse)
        mirrored = dr.max(specular)
        reflects = most + mirrored > 0
        return normal, KernelLobes(
            diffuse=diffuse,
            specular=specular,
            alpha=alpha,
            weight=dr.select(reflects, mirrored / (most + mirrored), 0),
            multiscatter=self._scattered_again(specular, alpha, active),
        )

    def _scattered_again(self, specular: Any, alpha: Any, active: Any) -> Any:
        """Return Fms (Color3f) of storage.optics.multiscatter."""
        place = dr.sqrt(alpha) * (ROUGHNESS_STEPS - 1)
        row = dr.minimum(mi.UInt32(place), ROUGHNESS_STEPS - 2)
        low = dr.gather(mi.Float, self._mean_albedo, row, active)
        high = dr.gather(mi.Float, self._mean_albedo, row + 1, active)
        mean = dr.lerp(low, high, place - mi.Float(row))
        return specular * mean / (1 - specular * (1 - mean))


def surface_table(scene: Scene, order: NDArray[np.intp]) -> SurfaceTable:
    """Return the table of a scene, with textures where it has some."""
    return TexturedTable(scene, order) if scene.textures else SurfaceTable(scene, order)
