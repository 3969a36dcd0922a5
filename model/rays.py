"""Ray bundles: directions through pixel centers, in camera space, patch by patch.

In camera space two views differ only in their field of view. Tested against
storage.conventions.camera_rays, which is the definition.
"""

import torch
from torch import Tensor


def ray_directions(fov_deg_V: Tensor, resolution: int) -> Tensor:
    """Return unit directions [..., 3, R, R] of square pictures; row 0 is the top.

    fov_deg [...] is the full angle in degrees; x points right, y up, and the camera looks along -z.
    """
    focal_px_V = 0.5 * resolution / torch.tan(torch.deg2rad(fov_deg_V) / 2)
    offset_R = torch.arange(resolution, dtype=fov_deg_V.dtype, device=fov_deg_V.device)
    offset_R = offset_R + 0.5 - 0.5 * resolution
    ones_VRR = torch.ones_like(focal_px_V)[..., None, None].expand(
        *focal_px_V.shape, resolution, resolution
    )
    direction_V3RR = torch.stack(
        [
            offset_R[None, :] * ones_VRR,
            -offset_R[:, None] * ones_VRR,
            -focal_px_V[..., None, None] * ones_VRR,
        ],
        dim=-3,
    )
    return direction_V3RR / direction_V3RR.norm(dim=-3, keepdim=True)


def bundle_rays(direction_V3RR: Tensor, patch_px: int) -> Tensor:
    """[..., 3, R, R] -> [..., Q, 3 P P]: bundles row by row, each flattened channel-major."""
    per_side = direction_V3RR.shape[-1] // patch_px
    grid = direction_V3RR.unflatten(-1, (per_side, patch_px)).unflatten(-3, (per_side, patch_px))
    bundles = torch.movedim(grid, (-4, -2), (-5, -4))
    return bundles.flatten(-5, -4).flatten(-3)


def unbundle(bundles_MQC: Tensor, patch_px: int) -> Tensor:
    """[M, Q, C P P] -> [M, C, R, R]: the inverse of `bundle_rays` for a square picture."""
    per_side = round(bundles_MQC.shape[1] ** 0.5)
    grid = bundles_MQC.unflatten(2, (-1, patch_px, patch_px)).unflatten(1, (per_side, per_side))
    return grid.permute(0, 3, 1, 4, 2, 5).flatten(4, 5).flatten(2, 3)
