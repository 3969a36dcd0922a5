"""`DeviceTextures`: the textures of a scene's triangles on a GPU, all in one row of texels."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.hits.device_arrays import DeviceArray, DevicePlace
from model.hits.textures import SurfaceTextures
from storage.records.material import laid_out
from storage.records.texture import CONSTANT, TEXTURED


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
