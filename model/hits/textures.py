"""`SurfaceTextures`: textures of a scene's triangles, as rays look them up where they hit.

On a GPU `DeviceTextures`, all in one row of texels.
"""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.hits.device_arrays import DeviceArray, DevicePlace
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


class DeviceTextures:
    """`SurfaceTextures` as tensors, in the same precision."""

    def __init__(self, textures: SurfaceTextures, place: DevicePlace) -> None:
        self.is_textured = place.array(textures.is_textured)
        self._uv_T32 = place.array(textures.uv_T32).tensor.double()
        self._rows_T3 = place.array(textures.rows_T3).tensor.long()
        texels: list[NDArray] = []
        sizes: list[tuple[int, int, int]] = []
        first = 0
        for texture in textures.textures:
            height, width = texture.texels.shape[:2]
            linear = texture.linear(texture.texels).reshape(height * width, -1)
            if linear.shape[1] == len(textures.channels):
                linear = linear[:, list(textures.channels)]
            texels.append(np.broadcast_to(linear, (len(linear), 3)))
            sizes.append((first, height, width))
            first += len(linear)
        places = {column.name: part for column, part in laid_out()}
        written = [
            (number, channel, column)
            for number, name in enumerate(TEXTURED)
            for channel, column in enumerate(range(places[name].start, places[name].stop))
        ]
        table = place.array(np.array(written, np.int64).T.copy()).tensor
        self._place, self._channel, self._column = table
        self._texels = place.array(np.concatenate(texels)).tensor
        self._sizes = place.array(np.array(sizes, np.int64)).tensor

    def materials(
        self, triangle: DeviceArray, weights: DeviceArray, materials_TM: DeviceArray
    ) -> DeviceArray:
        """Return the material rows [P, M] of points, as `SurfaceTextures.materials`."""
        rows = materials_TM.tensor[triangle.tensor]
        weights_P31 = weights.tensor.double().T[..., None]
        uv = (weights_P31 * self._uv_T32[triangle.tensor]).sum(dim=1).nan_to_num(0, 0, 0)
        texture_P3 = self._rows_T3[triangle.tensor]
        values = self._values(texture_P3.clamp(min=0), uv[:, None])[:, self._place, self._channel]
        textured = (texture_P3 != CONSTANT)[:, self._place]
        rows[:, self._column] = torch.where(textured, values.float(), rows[:, self._column])
        return DeviceArray(rows, triangle.place)

    def _values(self, texture: Tensor, uv: Tensor) -> Tensor:
        """Return values [P, K, 3] of textures [P, K] at [P, 1, 2], as storage.records.lookup."""
        first, height, width = self._sizes[texture].unbind(dim=-1)
        place = (uv - uv.floor()) * torch.stack([width, height], dim=-1) - 0.5
        corner = place.floor()
        along, across = (place - corner)[..., None].unbind(dim=-2)
        column, row = corner.long().unbind(dim=-1)
        columns = [(column + step) % width for step in (0, 1)]
        starts = [first + (row + step) % height * width for step in (0, 1)]
        texels = [[self._texels[start + each] for each in columns] for start in starts]
        rows = [(1 - along) * a + along * b for a, b in texels]
        return (1 - across) * rows[0] + across * rows[1]
