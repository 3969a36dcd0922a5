"""Where on the picture tokens land: rotary angles beside those of their vertices in space.

A bundle of rays that is told only where triangles stand has to work out which of them it looks at.
So keys and bundles also turn by two coordinates on the picture, in units of bundles: their products
then depend on how far from a bundle a token lands (docs/explanation/networks-and-training.md).
"""

import math

import torch
from torch import Tensor

from model.config import ModelConfig
from model.encoded_scene import TokenPlaces
from model.positions import Rotation, to_camera
from model.scene_tensors import Cameras

LOWEST, HIGHEST = 0.25, 1.75
"""Rotary frequencies in radians a bundle, log-spaced: waves of 25 to 3.6 bundles."""

NEAR_M = 1e-3
"""Depth that counts for all that is nearer, and for all behind the camera: it lands beyond the
border on its own side, and moves there without a jump as it passes the camera."""

BEYOND = 4.0
"""Bundles beyond the border at which everything farther out lands."""


class PictureRotary:
    """Turns the pairs of channels that vertices leave free."""

    def __init__(self, config: ModelConfig) -> None:
        self._first = config.vertex_pairs
        self._num_freqs = config.projected_freqs

    def of_tokens(
        self, rotation_BVNA: Rotation, places: TokenPlaces, cameras: Cameras, per_side: int
    ) -> Rotation:
        """Return the rotation of keys by where they stand, and by where they land."""
        inside_BVN33 = to_camera(places.positions_BN33, cameras.c2w_BV44)
        inside_BVN33 = inside_BVN33 * places.scale_BN11[:, None]
        return self._beside(rotation_BVNA, landed(inside_BVN33, cameras.fov_deg_BV, per_side))

    def of_bundles(self, per_side: int, like: Rotation) -> Rotation:
        """Return the rotation [Q, A] of bundles by their centres; no other pair turns."""
        count_S = torch.arange(per_side, dtype=like[0].dtype, device=like[0].device) + 0.5
        row_SS, column_SS = torch.meshgrid(count_S, count_S, indexing="ij")
        place_Q2 = torch.stack([column_SS, row_SS], dim=-1).flatten(0, 1)
        still_QA = place_Q2.new_zeros(len(place_Q2), like[0].shape[-1])
        return self._beside((still_QA + 1, still_QA), place_Q2)

    def _beside(self, rotation_NA: Rotation, place_N2: Tensor) -> Rotation:
        octaves_F = torch.linspace(
            math.log2(LOWEST), math.log2(HIGHEST), self._num_freqs, device=place_N2.device
        )
        angle_NA = (place_N2[..., None] * 2 ** octaves_F.to(place_N2.dtype)).flatten(-2)
        end = self._first + angle_NA.shape[-1]
        cos, sin = (
            torch.cat([turn[..., : self._first], mine, turn[..., end:]], dim=-1)
            for turn, mine in zip(rotation_NA, (angle_NA.cos(), angle_NA.sin()), strict=True)
        )
        return cos, sin


def landed(inside_BVN33: Tensor, fov_deg_BV: Tensor, per_side: int) -> Tensor:
    """Return where triangles land [B, V, N, 2]: column and row, in bundles from the top left.

    The mean of their three corners, each held within BEYOND of the picture, so that a triangle
    larger than the picture lands in it.

    Args:
        inside_BVN33: corners in each camera's space, which looks along -z.
        fov_deg_BV: full field of view in degrees.
        per_side: bundles along a side of the picture.
    """
    focal_BV11 = per_side / 2 / torch.tan(torch.deg2rad(fov_deg_BV) / 2)[..., None, None]
    depth_BVN3 = (-inside_BVN33[..., 2]).clamp(min=NEAR_M)
    column_BVN3 = per_side / 2 + focal_BV11 * inside_BVN33[..., 0] / depth_BVN3
    row_BVN3 = per_side / 2 - focal_BV11 * inside_BVN33[..., 1] / depth_BVN3
    corners_BVN32 = torch.stack([column_BVN3, row_BVN3], dim=-1)
    return corners_BVN32.clamp(-BEYOND, per_side + BEYOND).mean(dim=-2)
