"""`DeviceTextures`: the textures of a scene's triangles on a card, all in one row of texels."""

import numpy as np
import torch
from torch import Tensor

from model.hits.device_arrays import DeviceArray, DevicePlace
from model.hits.textures import SurfaceTextures
from storage.records.material import laid_out
from storage.records.texture import CONSTANT, TEXTURED


class DeviceTextures:
    """What `SurfaceTextures` says, in the same precision."""

    def __init__(self, textures: SurfaceTextures, place: DevicePlace) -> None:
        self.is_textured = place.array(textures.is_textured)
        self._uv_T32 = place.array(textures.uv_T32).tensor.double()
        self._rows_T3 = place.array(textures.rows_T3).tensor.long()
        texels, sizes, first = [], [], 0
        for texture in textures.textures:
            height, width = texture.texels.shape[:2]
            linear = texture.linear(texture.texels).reshape(height * width, -1)
            if linear.shape[1] == len(textures.channels):
                linear = linear[:, list(textures.channels)]
            texels.append(np.broadcast_to(linear, (len(linear), 3)))
            sizes.append((first, height, width))
            first += len(linear)
        self._texels = place.array(np.concatenate(texels)).tensor
        self._sizes = place.array(np.array(sizes, np.int64)).tensor

    def materials(
        self, triangle: DeviceArray, weights: DeviceArray, materials_TM: DeviceArray
    ) -> DeviceArray:
        """Return the material rows [P, M] of points, as `SurfaceTextures.materials`."""
        rows = materials_TM.tensor[triangle.tensor]
        weights_P31 = weights.tensor.double().T[..., None]
        uv = (weights_P31 * self._uv_T32[triangle.tensor]).sum(dim=1).nan_to_num(0, 0, 0)
        places = {column.name: part for column, part in laid_out()}
        for place, name in enumerate(TEXTURED):
            texture, part = self._rows_T3[triangle.tensor, place], places[name]
            values = self._values(texture.clamp(min=0), uv)[:, : part.stop - part.start]
            textured = (texture != CONSTANT)[:, None]
            rows[:, part] = torch.where(textured, values.float(), rows[:, part])
        return DeviceArray(rows, triangle.place)

    def _values(self, texture: Tensor, uv: Tensor) -> Tensor:
        """Return values [P, 3] of textures [P] at [P, 2], as storage.records.lookup has them."""
        first, height, width = self._sizes[texture].unbind(dim=1)
        x, y = (uv - uv.floor()).unbind(dim=1)
        x, y = x * width - 0.5, y * height - 0.5
        column, row = x.floor().long(), y.floor().long()
        along, across = (x - column)[:, None], (y - row)[:, None]

        def texels(down: int, right: int) -> Tensor:
            return self._texels[first + (row + down) % height * width + (column + right) % width]

        low = (1 - along) * texels(0, 0) + along * texels(0, 1)
        high = (1 - along) * texels(1, 0) + along * texels(1, 1)
        return (1 - across) * low + across * high
