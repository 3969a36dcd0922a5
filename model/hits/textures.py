"""`SurfaceTextures`: the textures of a scene's triangles, as rays look them up where they hit."""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from storage.records.lookup import texture_values
from storage.records.material import laid_out
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, Texture


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceTextures:
    """Textures of T triangles, which replace some of their material columns."""

    uv_T32: NDArray[np.float32]
    """Texture coordinates at the vertices of each triangle."""
    rows_T3: NDArray[np.int32]
    """Rows of `textures` for diffuse, specular and roughness, or CONSTANT."""
    textures: tuple[Texture, ...]
    """Textures that `rows_T3` points to."""
    channels: tuple[int, ...] = (0, 1, 2)
    """Channels of a color that are red, green and blue here."""

    @cached_property
    def is_textured(self) -> NDArray[np.bool_]:
        """[T] True for triangles with a texture."""
        textured: NDArray[np.bool_] = (self.rows_T3 != CONSTANT).any(axis=1)
        return textured

    def materials(
        self,
        triangle: NDArray[np.intp],
        weights: NDArray[np.float32],
        materials_TM: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the material rows [P, M] of points, exactly as storage.records.lookup has them.

        Args:
            triangle: [P] rows.
            weights: [3, P] of the vertices.
            materials_TM: published columns of the triangles.
        """
        rows = materials_TM[triangle]
        finite = np.nan_to_num(weights.astype(np.float64))  # of rays that have met nothing
        uv = np.einsum("cp,pci->pi", finite, self.uv_T32[triangle].astype(np.float64))
        places = {column.name: part for column, part in laid_out()}
        for place, name in enumerate(TEXTURED):
            texture_P = self.rows_T3[triangle, place]
            for row in np.unique(texture_P[texture_P != CONSTANT]):
                chosen = np.flatnonzero(texture_P == row)
                values = texture_values(self.textures[row], uv[chosen])
                if values.shape[1] == len(self.channels):
                    values = values[:, list(self.channels)]
                rows[chosen, places[name]] = values
        return rows

    def with_vertices(self, order_T3: NDArray[np.integer]) -> "SurfaceTextures":
        """Return the textures of the same triangles with their vertices in another order."""
        uv_T32 = np.take_along_axis(self.uv_T32, order_T3[..., None].astype(np.int64), axis=1)
        return dataclasses.replace(self, uv_T32=uv_T32)

    def with_channels(self, order: NDArray[np.integer]) -> "SurfaceTextures":
        """Return the textures with the color channels in another order."""
        return dataclasses.replace(
            self, channels=tuple(self.channels[int(channel)] for channel in order)
        )


def surface_textures(scene: Scene) -> SurfaceTextures | None:
    """Return the textures of a scene, or None where it has none."""
    if scene.uv is None or scene.material_textures is None:
        return None
    return SurfaceTextures(
        uv_T32=scene.uv.reshape(-1, 3, 2),
        rows_T3=scene.material_textures[scene.material_index],
        textures=scene.textures,
    )
