"""`AnchorOffset`: offsets of pixels to the nine anchors around them: position, plane, normal."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from model.hits.view_inputs import Channel

NEIGHBOURS = 9
"""Anchors that a pixel reads: the anchor of its tile of the picture and its eight neighbors."""

OFFSET_DIM = 6
"""Number of features of a pixel's offset to a mixture of anchors."""

FARTHEST = 30.0
"""Limit of differences: an anchor at the limit has weight 0 unless all anchors are there."""

_NEAREST_M = 1e-3
"""Added to distances, so that a pixel that meets nothing divides by more than 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AnchorOffset:
    """Offsets of pixels to nine anchors, as fractions of the pixels' distance to the camera."""

    unlike: tuple[Tensor, Tensor, Tensor]
    """[M, P, 9] distance to the anchor, its distance to the pixel's plane, change of normal."""
    anchors_M93: Tensor
    """Positions of the anchors relative to the central one, meters."""
    pixels_MP3: Tensor
    """Positions of the pixels relative to the central anchor, meters."""
    distance_MP1: Tensor

    def mixture_offset(self, share_MP9: Tensor) -> Tensor:
        """Return the offset of each pixel to its mixture of anchors, [M, P, 6]."""
        unlike = [(share_MP9 * each).sum(dim=-1) for each in self.unlike]
        offset = (share_MP9 @ self.anchors_M93 - self.pixels_MP3) / self.distance_MP1
        return torch.cat([torch.stack(unlike, dim=-1), 4 * offset], dim=-1)


def offsets_to_anchors(pixels_MPC: Tensor, anchors_M9C: Tensor) -> AnchorOffset:
    """Return offsets to the anchors around; products of matrices, without [M, P, 9, 3]."""
    center = anchors_M9C[:, NEIGHBOURS // 2, None, Channel.POSITION]
    pixels_MP3 = pixels_MPC[..., Channel.POSITION] - center
    anchors_M93 = anchors_M9C[..., Channel.POSITION] - center
    distance_MP1 = pixels_MPC[..., Channel.DISTANCE] + _NEAREST_M
    normal = normalize(pixels_MPC[..., Channel.NORMAL], dim=-1)
    other = normalize(anchors_M9C[..., Channel.NORMAL], dim=-1)
    squares = pixels_MP3.square().sum(dim=-1, keepdim=True)
    squares = squares + anchors_M93.square().sum(dim=-1)[:, None]
    separation = (squares - 2 * pixels_MP3 @ anchors_M93.mT).clamp(min=0).sqrt()
    above = normal @ anchors_M93.mT - (normal * pixels_MP3).sum(dim=-1, keepdim=True)
    return AnchorOffset(
        unlike=(
            (8 * separation / distance_MP1).clamp(max=FARTHEST),
            (30 * above.abs() / distance_MP1).clamp(max=FARTHEST),
            2 - 2 * normal @ other.mT,
        ),
        anchors_M93=anchors_M93,
        pixels_MP3=pixels_MP3,
        distance_MP1=distance_MP1,
    )
