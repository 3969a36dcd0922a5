"""The view stage: ray bundles of one camera ask the scene what they see.

It runs in camera space: the context is turned into each camera's frame by rotating its keys, the
bundles stand at the origin. The scene's tokens themselves are the same for every view.
"""

import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.image_head import build_head, stack_taps
from model.layers import TOKEN_NORM_EPS, DecoderLayer
from model.positions import TriangleRotary, to_camera
from model.rays import bundle_rays, ray_directions
from model.scene_tensors import SceneBatch
from model.triangle_encoder import token_mask, token_positions


class ViewDecoder(nn.Module):
    """Context and cameras -> pictures."""

    def __init__(self, config: ModelConfig, rotary: TriangleRotary) -> None:
        super().__init__()
        self.rotary = rotary
        self.patch_px = config.patch_px
        self.num_registers = config.num_registers
        self.token_W = nn.Parameter(torch.zeros(config.width))
        self.rays = nn.Linear(3 * config.patch_px**2, config.width)
        self.rays_norm = nn.RMSNorm(config.width, eps=TOKEN_NORM_EPS)
        self.layers = nn.ModuleList(
            DecoderLayer(config.width, config.num_heads, config.hidden_width)
            for _ in range(config.decoder_layers)
        )
        self.head = build_head(config)

    def forward(self, context_BNW: Tensor, batch: SceneBatch, resolution: int) -> Tensor:
        """Return log10(1 + radiance) before the ELU, [B, V, R, R, 3]."""
        x_BVQW = self.bundle_tokens(batch.fov_deg_BV, resolution)
        positions_BN33 = token_positions(batch, self.num_registers)
        rotation_BVNA = self.rotary(to_camera(positions_BN33, batch.c2w_BV44))
        is_key_BN = token_mask(batch, self.num_registers)
        layers = []
        for layer in self.layers:
            x_BVQW = layer(x_BVQW, context_BNW, rotation_BVNA, is_key_BN)
            layers.append(x_BVQW)
        picture_M3RR = self.head(stack_taps(layers, self.head.taps))
        return picture_M3RR.movedim(1, -1).unflatten(0, batch.fov_deg_BV.shape)

    def bundle_tokens(self, fov_deg_BV: Tensor, resolution: int) -> Tensor:
        """Return the tokens [B, V, Q, W] of all bundles of square pictures."""
        rays_BVQC = bundle_rays(ray_directions(fov_deg_BV, resolution), self.patch_px)
        return self.token_W + self.rays_norm(self.rays(rays_BVQC))
