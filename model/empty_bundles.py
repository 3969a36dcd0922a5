"""Which ray bundles can see something: the others may be left out of the view stage.

A bundle is kept where the bounds of some projected triangle touch it, or touch a neighbour of it.
That is conservative: no bundle that sees geometry is ever left out. What is left out is black,
which is what it would have been asked to learn; but bundles also attend to each other, so that
those which remain change a little. How much, and what is saved, is measured in docs/explanation.
"""

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from model.encoded_scene import TokenPlaces
from model.positions import to_camera
from model.scene_tensors import Cameras

NEAR_M = 1e-3
"""Triangles are cut at this distance before the camera: nearer, a projection has no bounds."""


def bundles_that_see(
    places: TokenPlaces, cameras: Cameras, resolution: int, patch_px: int
) -> Tensor:
    """Return whether geometry may reach each bundle, bool [B, V, Q]."""
    triangles_BT33 = places.positions_BN33[:, places.num_registers :]
    corners_BVT62, exists_BVT6 = _cut_corners(to_camera(triangles_BT33, cameras.c2w_BV44))
    if places.is_key_BN is not None:
        exists_BVT6 = exists_BVT6 & places.is_key_BN[:, None, places.num_registers :, None]
    per_side = resolution // patch_px
    half_width_BV = torch.tan(torch.deg2rad(cameras.fov_deg_BV) / 2)
    bundle_BVT62 = (corners_BVT62 / half_width_BV[..., None, None, None] + 1) * (per_side / 2)
    far = torch.full_like(bundle_BVT62, torch.inf)
    low_BVT2 = torch.where(exists_BVT6[..., None], bundle_BVT62, far).amin(dim=-2)
    high_BVT2 = torch.where(exists_BVT6[..., None], bundle_BVT62, -far).amax(dim=-2)
    counts_BVSS = _cover(low_BVT2, high_BVT2, per_side)
    return max_pool2d((counts_BVSS > 0).double(), 3, stride=1, padding=1).flatten(-2) > 0


def fill_absent(tokens_1KW: Tensor, sees_Q: Tensor) -> Tensor:
    """Return tokens [1, Q, W] of all bundles: the mean of those that were computed for the rest."""
    filled_1QW = tokens_1KW.mean(dim=1, keepdim=True).repeat(1, len(sees_Q), 1)
    filled_1QW[:, sees_Q] = tokens_1KW
    return filled_1QW


def blacken_absent(picture_CRR: Tensor, sees_Q: Tensor, patch_px: int) -> Tensor:
    """Return the picture, log10(1 + radiance), with 0 where no bundle was computed."""
    per_side = picture_CRR.shape[-1] // patch_px
    sees_RR = sees_Q.unflatten(0, (per_side, per_side)).repeat_interleave(patch_px, dim=0)
    return picture_CRR * sees_RR.repeat_interleave(patch_px, dim=1)


def _cut_corners(triangles_BVT33: Tensor) -> tuple[Tensor, Tensor]:
    """Return picture-plane points [B, V, T, 6, 2] (x right, y down, at depth 1), and which exist.

    The three vertices, where they lie before the near plane, and where the edges pierce it.
    """
    nearer_BVT33 = triangles_BVT33.roll(-1, dims=-2)
    depth, next_depth = -triangles_BVT33[..., 2], -nearer_BVT33[..., 2]
    share = (NEAR_M - depth) / torch.where(next_depth == depth, 1, next_depth - depth)
    pierced_BVT33 = triangles_BVT33 + share[..., None] * (nearer_BVT33 - triangles_BVT33)
    points = torch.cat([triangles_BVT33, pierced_BVT33], dim=-2)
    depths = torch.cat([depth, torch.full_like(depth, NEAR_M)], dim=-1)
    in_front = depth >= NEAR_M
    exists = torch.cat([in_front, in_front != in_front.roll(-1, dims=-1)], dim=-1)
    plane = torch.stack([points[..., 0], -points[..., 1]], dim=-1)
    return plane / depths.clamp_min(NEAR_M)[..., None], exists


def _cover(low_BVT2: Tensor, high_BVT2: Tensor, per_side: int) -> Tensor:
    """Return how many boxes touch each cell, [B, V, S, S] (row, column), by a summed-area table."""
    first = low_BVT2.floor().clamp(0, per_side)
    last = (high_BVT2.floor() + 1).clamp(0, per_side)
    touches = (first < last).all(dim=-1)
    first, last = (torch.where(touches[..., None], x, 0).long() for x in (first, last))
    table = low_BVT2.new_zeros((*low_BVT2.shape[:2], (per_side + 1) ** 2))
    for row, column, sign in (
        (first, first, 1),
        (first, last, -1),
        (last, first, -1),
        (last, last, 1),
    ):
        cell = row[..., 1] * (per_side + 1) + column[..., 0]
        table.scatter_add_(-1, cell, (sign * touches).to(table.dtype))
    grid = table.unflatten(-1, (per_side + 1, per_side + 1))
    return grid.cumsum(-1).cumsum(-2)[..., :per_side, :per_side]
