"""`Lie`: how pixels lie to the nine anchors around them, by place, plane and normal."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from model.hits.view_inputs import Channel

NEIGHBOURS = 9
"""Anchors that a pixel reads: that of its own part of the picture and those around it."""

PLACE = 6
"""Numbers that say how a pixel lies to a mixture of anchors."""

FARTHEST = 30.0
"""What counts as far away: an anchor there has no share but where all are."""

_NEAREST_M = 1e-3
"""Added to distances, so that a pixel that meets nothing divides by more than 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lie:
    """How pixels lie to nine anchors, in shares of their distance to the camera."""

    unlike: tuple[Tensor, Tensor, Tensor]
    """[M, P, 9] how far the anchor is, how far from the pixel's plane, and how the normals differ.
    """
    anchors_M93: Tensor
    """Positions, from that of the part's own anchor."""
    pixels_MP3: Tensor
    """Likewise."""
    distance_MP1: Tensor

    def mixed(self, share_MP9: Tensor) -> Tensor:
        """Return what lies between a pixel and a mixture of anchors, [M, P, 6]."""
        unlike = [(share_MP9 * each).sum(dim=-1) for each in self.unlike]
        way = (share_MP9 @ self.anchors_M93 - self.pixels_MP3) / self.distance_MP1
        return torch.cat([torch.stack(unlike, dim=-1), 4 * way], dim=-1)


def lies_to(pixels_MPC: Tensor, anchors_M9C: Tensor) -> Lie:
    """Return how pixels lie to the anchors around; products of matrices, without [M, P, 9, 3]."""
    own = anchors_M9C[:, NEIGHBOURS // 2, None, Channel.POSITION]
    pixels_MP3 = pixels_MPC[..., Channel.POSITION] - own
    anchors_M93 = anchors_M9C[..., Channel.POSITION] - own
    distance_MP1 = pixels_MPC[..., Channel.DISTANCE] + _NEAREST_M
    normal = normalize(pixels_MPC[..., Channel.NORMAL], dim=-1)
    other = normalize(anchors_M9C[..., Channel.NORMAL], dim=-1)
    squares = pixels_MP3.square().sum(dim=-1, keepdim=True)
    squares = squares + anchors_M93.square().sum(dim=-1)[:, None]
    apart = (squares - 2 * pixels_MP3 @ anchors_M93.mT).clamp(min=0).sqrt()
    above = normal @ anchors_M93.mT - (normal * pixels_MP3).sum(dim=-1, keepdim=True)
    return Lie(
        unlike=(
            (8 * apart / distance_MP1).clamp(max=FARTHEST),
            (30 * above.abs() / distance_MP1).clamp(max=FARTHEST),
            2 - 2 * normal @ other.mT,
        ),
        anchors_M93=anchors_M93,
        pixels_MP3=pixels_MP3,
        distance_MP1=distance_MP1,
    )
