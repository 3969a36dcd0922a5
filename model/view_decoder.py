"""View stage (decoder): ray bundles of a camera attend to the tokens of the scene.

It runs in camera space: rotating the keys transforms the context to each camera's space, and the
bundles are at the origin. The scene's tokens themselves are the same for every view.
"""

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.encoded_scene import EncodedScene, KeysValues, TokenPositions
from model.image_head import DptHead, LinearHead
from model.layers import TOKEN_NORM_EPS, DecoderLayer, Norm, dtype_of, run_layer
from model.packing import Packing
from model.positions import (
    Rotation,
    TriangleRotary,
    camera_rotation,
    packed_camera_rotation,
)
from model.precision import without_autocast
from model.rays import bundle_rays, ray_directions
from model.rounding import rounded_call, rounded_parts_of
from model.scene_tensors import Cameras
from model.windows import Windows, cut_windows

Cuts = tuple[Windows | None, Windows | None]
"""Windows of even and of odd layers; None if every bundle attends to all others."""


class ViewDecoder(nn.Module):
    """Decoder from context and cameras to pictures."""

    def __init__(self, config: ModelConfig, rotary: TriangleRotary) -> None:
        super().__init__()
        self.rotary = rotary
        self.patch_px = config.patch_px
        self.window_bundles = config.window_bundles
        self.recompute = False
        self.token_W = nn.Parameter(torch.zeros(config.width))
        self.rays = nn.Linear(3 * config.patch_px**2, config.width)
        self.rays_norm = Norm(config.width, eps=TOKEN_NORM_EPS)
        self.layers = nn.ModuleList(
            DecoderLayer(config.width, config.num_heads, config.hidden_width)
            for _ in range(config.decoder_layers)
        )
        is_dpt = config.head == "dpt"
        self.head: LinearHead | DptHead = DptHead(config) if is_dpt else LinearHead(config)

    def keys_values(
        self, context_BNW: Tensor, places: TokenPositions, packing: Packing | None = None
    ) -> tuple[KeysValues, ...]:
        """Return each layer's keys and values of a context: once per scene, for any views.

        Keys are not rotated yet, since that needs a camera.
        """
        layers = cast(Iterable[DecoderLayer], self.layers)
        return tuple(layer.cross.keys_values(context_BNW) for layer in layers)

    def forward(self, scene: EncodedScene, cameras: Cameras, resolution: int) -> Tensor:
        """Return log10(1 + radiance) before the ELU, [B, V, R, R, 3].

        A demodulated network returns light, [B, V, R, R, 6] (model.demodulated).
        """
        # packed keys are grouped by view, so views come before scenes for the bundles too
        views_first = scene.packing is not None
        fov_deg_BV = cameras.fov_deg_BV.T if views_first else cameras.fov_deg_BV
        x_BVQW = self.bundle_tokens(fov_deg_BV, resolution)
        rotation = camera_rotation(self.rotary, scene.places, cameras.c2w_BV44)
        if scene.packing is not None:
            rotation = packed_camera_rotation(rotation, scene.packing)
        cuts = self._cuts(resolution // self.patch_px, x_BVQW.device)
        taps = self._taps(x_BVQW, scene, rotation, cuts)
        weights = rounded_parts_of(self.head, self.head.rounded_parts(), x_BVQW.device)
        picture_MCRR = rounded_call(self.head, weights, taps)
        picture_BVRRC = picture_MCRR.movedim(1, -1).unflatten(0, fov_deg_BV.shape)
        return picture_BVRRC.transpose(0, 1) if views_first else picture_BVRRC

    def _taps(
        self, x_BVQW: Tensor, scene: EncodedScene, rotation: Rotation, cuts: Cuts
    ) -> list[Tensor]:
        """Return the outputs [B V, Q, W] of the layers that the head reads."""
        x_BVQW = x_BVQW.to(dtype_of(self.layers))
        keys = scene.keys(views=rotation[0].shape[1])
        outputs = {}
        for index, (layer, keys_values) in enumerate(
            zip(self.layers, scene.keys_values, strict=True)
        ):
            x_BVQW = run_layer(
                layer,
                x_BVQW,
                keys_values,
                rotation,
                keys,
                cuts[index % 2],
                recompute=self.recompute,
            )
            if index in self.head.taps:
                outputs[index] = x_BVQW
        return [torch.flatten(outputs[tap], 0, 1) for tap in self.head.taps]

    def bundle_tokens(self, fov_deg_BV: Tensor, resolution: int) -> Tensor:
        """Return the tokens [B, V, Q, W] of square pictures, float32 under autocast too."""
        rays_BVQC = bundle_rays(ray_directions(fov_deg_BV, resolution), self.patch_px)
        with without_autocast(rays_BVQC.device):
            return self.token_W + self.rays_norm(self.rays(rays_BVQC))

    def _cuts(self, per_side: int, device: torch.device) -> Cuts:
        if not self.window_bundles:
            return None, None
        even_cut, odd_cut = (
            cut_windows(per_side, self.window_bundles, shifted=shifted, device=device)
            for shifted in (False, True)
        )
        return even_cut, odd_cut
