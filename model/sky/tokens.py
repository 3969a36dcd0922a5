"""Tokens of a sky: where its light comes from and how much, for the view-independent stage.

They stand where registers do, at the mean vertex: what is infinitely far away is nowhere. A scene
without a sky has none of them; beside one that has, they are hidden as padding is.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.encoded_scene import TokenPlaces
from model.layers import TOKEN_NORM_EPS, Norm
from model.positions import encode_normals
from model.precision import as_given
from model.sky.cells import sky_cells
from storage.records.environment import Environment


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyBatch:
    """The skies of B scenes in S cells each."""

    radiance_BS3: Tensor
    """Mean radiance; 0 of scenes without a sky."""
    direction_BS3: Tensor
    """model.sky.cells."""
    exists_B: Tensor
    """bool: whether a scene has a sky."""


def sky_batch(
    skies: tuple[Environment | None, ...] | None, count: int, like: Tensor
) -> SkyBatch | None:
    """Return the cells of a batch, where and of the type of a tensor; None where there are none."""
    if not count or skies is None:
        return None
    light = np.zeros((2, len(skies), count, 3), np.float32)
    for row, sky in enumerate(skies):
        if sky is not None:
            cells = sky_cells(sky, count)
            light[0, row], light[1, row] = cells.radiance_S3, cells.direction_S3
    radiance_BS3, direction_BS3 = torch.from_numpy(light).to(like.device, like.dtype)
    exists_B = torch.tensor([sky is not None for sky in skies], device=like.device)
    return SkyBatch(radiance_BS3=radiance_BS3, direction_BS3=direction_BS3, exists_B=exists_B)


def without_absent(places: TokenPlaces, skies: SkyBatch, num_registers: int) -> TokenPlaces:
    """Return places in which the sky's tokens of scenes without a sky are no keys."""
    if skies.exists_B.all():
        return places
    is_key_BN = places.is_key_BN
    if is_key_BN is None:
        is_key_BN = torch.ones_like(places.positions_BN33[..., 0, 0], dtype=torch.bool)
    is_key_BN = is_key_BN.clone()
    count = skies.radiance_BS3.shape[1]
    is_key_BN[:, num_registers : num_registers + count] &= skies.exists_B[:, None]
    return TokenPlaces(
        positions_BN33=places.positions_BN33,
        scale_BN11=places.scale_BN11,
        is_key_BN=is_key_BN,
        num_registers=places.num_registers,
    )


class SkyTokens(nn.Module):
    """Cells -> tokens."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.octaves = config.normal_octaves
        self.cell = nn.Linear(3 + 3 + 6 * self.octaves, config.width)
        self.norm = Norm(config.width, eps=TOKEN_NORM_EPS)

    def forward(self, skies: SkyBatch, unit_B3: Tensor | None) -> Tensor:
        """Return [B, S, W]: log10(1 + radiance), in units of a scene's light where it has one.

        Emission is told in the same units, so that lamps and sky compare.
        """
        with as_given(skies.radiance_BS3.device):
            radiance_BS3 = skies.radiance_BS3
            if unit_B3 is not None:
                radiance_BS3 = radiance_BS3 / unit_B3[:, None]
            direction = encode_normals(skies.direction_BS3[..., None, :], self.octaves)
            told = torch.cat([torch.log10(1 + radiance_BS3), direction], dim=-1)
            tokens: Tensor = self.norm(self.cell(told))
            return tokens
