"""The view stage: ray bundles of one camera ask the scene what they see.

It runs in camera space: the context is turned into each camera's frame by rotating its keys, the
bundles stand at the origin. The scene's tokens themselves are the same for every view.
"""

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.empty_bundles import blacken_absent, bundles_that_see, fill_absent
from model.encoded_scene import EncodedScene, KeysValues, TokenPlaces
from model.image_head import build_head, stack_taps
from model.layers import TOKEN_NORM_EPS, DecoderLayer, Norm, dtype_of, run_layer
from model.packing import Packing
from model.positions import (
    Rotation,
    TriangleRotary,
    camera_rotation,
    packed_camera_rotation,
)
from model.precision import as_given
from model.projected import PictureRotary
from model.rays import bundle_rays, ray_directions
from model.rounding import rounded_call, rounded_parts_of
from model.scene_tensors import Cameras
from model.windows import Windows, cut_windows

Cuts = tuple[Windows | None, Windows | None]
"""Windows of even and of odd layers; None where every bundle sees all others."""

Rotations = tuple[Rotation, Rotation | None]
"""Of keys [B, V, N, A] and of bundles [Q, A]; None where bundles do not turn."""


class ViewDecoder(nn.Module):
    """Context and cameras -> pictures."""

    def __init__(self, config: ModelConfig, rotary: TriangleRotary) -> None:
        super().__init__()
        self.rotary = rotary
        self.patch_px = config.patch_px
        self.window_bundles = config.window_bundles
        self.projected = PictureRotary(config) if config.projected_freqs else None
        self.recompute = False
        self.token_W = nn.Parameter(torch.zeros(config.width))
        self.rays = nn.Linear(3 * config.patch_px**2, config.width)
        self.rays_norm = Norm(config.width, eps=TOKEN_NORM_EPS)
        self.layers = nn.ModuleList(
            DecoderLayer(config.width, config.num_heads, config.hidden_width)
            for _ in range(config.decoder_layers)
        )
        self.head = build_head(config)

    def keys_values(
        self, context_BNW: Tensor, places: TokenPlaces, packing: Packing | None = None
    ) -> tuple[KeysValues, ...]:
        """Return what each layer asks of a context: once per scene, for any number of views.

        Keys are not rotated yet, wherever their tokens stand: that takes a camera.
        """
        layers = cast(Iterable[DecoderLayer], self.layers)
        return tuple(layer.cross.keys_values(context_BNW) for layer in layers)

    def forward(self, scene: EncodedScene, cameras: Cameras, resolution: int) -> Tensor:
        """Return log10(1 + radiance) before the ELU, [B, V, R, R, 3].

        Of a network that predicts light, what `model.demodulated.composed` reads, [B, V, R, R, 6].
        """
        # the packed keys of a view lie together, and so do its bundles: views come before scenes
        is_turned = scene.packing is not None
        fov_deg_BV = cameras.fov_deg_BV.T if is_turned else cameras.fov_deg_BV
        x_BVQW = self.bundle_tokens(fov_deg_BV, resolution)
        rotations = self._rotations(scene, cameras, resolution)
        cuts = self._cuts(resolution // self.patch_px, x_BVQW.device)
        taps = self._taps(x_BVQW, scene, rotations, cuts)
        weights = rounded_parts_of(self.head, self.head.rounded_parts(), x_BVQW.device)
        picture_MCRR = rounded_call(self.head, weights, taps)
        picture_BVRRC = picture_MCRR.movedim(1, -1).unflatten(0, fov_deg_BV.shape)
        return picture_BVRRC.transpose(0, 1) if is_turned else picture_BVRRC

    def where_seen(self, scene: EncodedScene, cameras: Cameras, resolution: int) -> Tensor:
        """Return what `forward` returns for one scene, from the bundles that see it alone.

        The others are black and cost nothing. View by view, as each keeps its own number of
        bundles; a DPT, which also reads what lies around those, is given their mean there.
        """
        x_1VQW = self.bundle_tokens(cameras.fov_deg_BV, resolution)
        sees_VQ = bundles_that_see(scene.places, cameras, resolution, self.patch_px)[0]
        (cos, sin), asks = self._rotations(scene, cameras, resolution)
        pictures = []
        for view, sees_Q in enumerate(sees_VQ):
            picture_CRR = x_1VQW.new_zeros((self.head.channels, resolution, resolution))
            if sees_Q.any():
                x_11QW = x_1VQW[:, [view]][:, :, sees_Q]
                keys = cos[:, [view]], sin[:, [view]]
                some = None if asks is None else (asks[0][sees_Q], asks[1][sees_Q])
                taps_1QW = self._taps(x_11QW, scene, (keys, some), (None, None))
                filled_1QW = [fill_absent(tap_1QW, sees_Q) for tap_1QW in taps_1QW]
                picture_CRR = blacken_absent(self.head(filled_1QW)[0], sees_Q, self.patch_px)
            pictures.append(picture_CRR)
        return torch.stack(pictures).movedim(1, -1)[None]

    def _rotations(self, scene: EncodedScene, cameras: Cameras, resolution: int) -> Rotations:
        """Return the rotations of keys [B, V, N, A], or packed [1, V, P, A]; and of bundles."""
        keys_BVNA = camera_rotation(self.rotary, scene.places, cameras.c2w_BV44)
        bundles_QA = None
        if self.projected is not None:
            per_side = resolution // self.patch_px
            bundles_QA = self.projected.of_bundles(per_side, keys_BVNA)
            keys_BVNA = self.projected.of_tokens(keys_BVNA, scene.places, cameras, per_side)
        if scene.packing is not None:
            keys_BVNA = packed_camera_rotation(keys_BVNA, scene.packing)
        return keys_BVNA, bundles_QA

    def _taps(
        self, x_BVQW: Tensor, scene: EncodedScene, rotations: Rotations, cuts: Cuts
    ) -> list[Tensor]:
        """Return what the head reads, [B V, Q, W] each."""
        x_BVQW = x_BVQW.to(dtype_of(self.layers))
        keys = scene.keys(views=rotations[0][0].shape[1])
        outputs = {}
        for index, (layer, keys_values) in enumerate(
            zip(self.layers, scene.keys_values, strict=True)
        ):
            x_BVQW = run_layer(
                layer,
                x_BVQW,
                keys_values,
                *rotations,
                keys,
                cuts[index % 2],
                recompute=self.recompute,
            )
            if index in self.head.taps:
                outputs[index] = x_BVQW
        return stack_taps(outputs, self.head.taps)

    def bundle_tokens(self, fov_deg_BV: Tensor, resolution: int) -> Tensor:
        """Return the tokens [B, V, Q, W] of square pictures, float32 under autocast too."""
        rays_BVQC = bundle_rays(ray_directions(fov_deg_BV, resolution), self.patch_px)
        with as_given(rays_BVQC.device):
            return self.token_W + self.rays_norm(self.rays(rays_BVQC))

    def _cuts(self, per_side: int, device: torch.device) -> Cuts:
        if not self.window_bundles:
            return None, None
        even, odd = (
            cut_windows(per_side, self.window_bundles, shifted=shifted, device=device)
            for shifted in (False, True)
        )
        return even, odd
