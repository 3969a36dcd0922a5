"""The whole network (RenderFormer, Zeng et al. 2025): assembles the two stages, nothing else."""

import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.image_head import blacken
from model.positions import TriangleRotary
from model.scene_tensors import SceneBatch
from model.triangle_encoder import TriangleEncoder
from model.view_decoder import ViewDecoder
from storage.errors import TrilightError

ELU_ALPHA = 1e-3
"""How far below 0 the published output may go: a picture's radiance stays above -0.0023."""

TOKEN_STD = 0.02
"""Spread of the learned tokens at the start; their neighbours in the sum have unit size."""


class RenderFormer(nn.Module):
    """Triangles, materials and cameras -> pictures.

    It is exact under translation of the world and permutation of triangles, and has to learn
    everything else: rotation, mirroring and the order of a triangle's vertices.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        rotary = TriangleRotary(
            num_freqs=config.rope_num_freqs,
            max_freq=config.rope_max_freq,
            head_width=config.head_width,
        )
        self.encoder = TriangleEncoder(config, rotary)
        self.decoder = ViewDecoder(config, rotary)

    def forward(self, batch: SceneBatch, resolution: int) -> Tensor:
        """Return log10(1 + radiance) [B, V, R, R, 3], before the ELU: what training compares.

        The encoder runs once per scene, whatever the number of views.

        Raises:
            TrilightError: the resolution is not a multiple of the bundle's width.
        """
        patch_px = self.config.patch_px
        if resolution < patch_px or resolution % patch_px:
            raise TrilightError(
                f"resolution {resolution}: expected a multiple of {patch_px}, the width of a ray "
                "bundle. Choose the next one."
            )
        return self.decoder(self.encoder(batch), batch, resolution)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw all weights: Xavier for matrices, small tokens, a black picture."""
        for module in self.modules():
            if isinstance(module, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(module.weight, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        for token in (self.encoder.tokens.token_W, self.encoder.registers_NW, self.decoder.token_W):
            nn.init.normal_(token, std=TOKEN_STD, generator=generator)
        blacken(self.decoder.head)


def radiance(log10_rgb: Tensor) -> Tensor:
    """Return the linear radiance of the network's output: ELU, then 10^x - 1.

    For pictures only. The ELU's slope is a thousandth below 0, so a loss behind it lets a network
    die that once went dark.
    """
    return torch.pow(10.0, nn.functional.elu(log10_rgb, alpha=ELU_ALPHA)) - 1.0


def count_parameters(model: nn.Module) -> int:
    """Return how many numbers training changes."""
    return sum(weight.numel() for weight in model.parameters())
