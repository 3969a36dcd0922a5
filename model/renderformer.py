"""The whole network (RenderFormer, Zeng et al. 2025): triangle encoder, and both stages assembled.

The view-independent stage (encoder) computes light transport between triangles, once per scene.
Every triangle is one token: the sum of a learned vector, its material and its normals. Its position
enters only through rotary encodings. Registers are at the mean of all vertices.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from model.attention import Keys, Packing, pack_tokens
from model.config import ModelConfig
from model.hits.decoder import HitDecoder
from model.hits.lit_scene import LitScene
from model.hits.traced import Traced, denoise_traced
from model.hits.tracing import albedo_of_cameras, as_tensor, like, lit_scenes, traced_cameras
from model.layers import TOKEN_NORM_EPS, EncoderLayer, Norm, dtype_of, run_layer
from model.positions import (
    EncodedScene,
    KeysValues,
    TokenPositions,
    TriangleRotary,
    encode_normals,
    encoded_normal_width,
    packed_rotation,
    token_positions,
    world_rotation,
)
from model.precision import tf32, without_autocast
from model.scene_tensors import Cameras, SceneBatch, in_light_units, require_known_sky
from model.view_decoder import ViewDecoder, compose_radiance
from storage.records.material import material_width

SIDE_LIGHTS = 12
"""Number of light values of the two sides of a triangle (model.hits.traced)."""


class TriangleTokens(nn.Module):
    """Embedding of material and normals as tokens.

    The published network reads a 13 x 32 x 32 texture whose cells are all equal; that is a linear
    map of the ten numbers (its tangent-space normal is constant), at a thousandth of the input.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.octaves = config.normal_octaves
        self.token_W = nn.Parameter(torch.zeros(config.width))
        self.material = nn.Linear(material_width(config.material_columns), config.width)
        self.material_norm = Norm(config.width, eps=TOKEN_NORM_EPS)
        self.normal = nn.Linear(encoded_normal_width(self.octaves), config.width)
        self.normal_norm = Norm(config.width, eps=TOKEN_NORM_EPS)
        self.light = nn.Linear(SIDE_LIGHTS, config.width) if config.traces_hits else None

    def forward(
        self, material_BTM: Tensor, normals_BT33: Tensor, light_BTL: Tensor | None = None
    ) -> Tensor:
        """Return tokens [B, T, W], float32 under autocast too.

        `light` is what the triangles' sides receive, in units of the scene's mean light, as an
        input of networks with the view stage `hits`. It is compressed to log1p(4 x), since it spans
        orders of magnitude; the curve is linear below a quarter of the mean, and logarithmic above.
        """
        with without_autocast(material_BTM.device):
            material_BTW = self.material_norm(self.material(material_BTM))
            normal_BTW = self.normal_norm(self.normal(encode_normals(normals_BT33, self.octaves)))
            tokens_BTW = self.token_W + material_BTW + normal_BTW
            if self.light is None or light_BTL is None:
                return tokens_BTW
            return tokens_BTW + self.light(torch.log1p(4 * light_BTL))


class TriangleEncoder(nn.Module):
    """Encoder of a batch of scenes to context tokens, registers first."""

    def __init__(self, config: ModelConfig, rotary: TriangleRotary) -> None:
        super().__init__()
        self.rotary = rotary
        self.recompute = False
        self.columns = config.material_columns
        self.tokens = TriangleTokens(config)
        self.registers_NW = nn.Parameter(torch.zeros(config.num_registers, config.width))
        self.layers = nn.ModuleList(
            EncoderLayer(config.width, config.num_heads, config.hidden_width)
            for _ in range(config.encoder_layers)
        )

    def forward(
        self,
        batch: SceneBatch,
        places: TokenPositions,
        light_BTL: Tensor | None = None,
        packing: Packing | None = None,
    ) -> Tensor:
        """Return the context [B, N, W] with N = registers + triangles.

        `light_BTL` is as in TriangleTokens. With a packing the context is one row of all valid
        tokens, [1, P, W].
        """
        materials = batch.material_of(self.columns)
        tokens_BTW = self.tokens(materials, batch.normals_BT33, light_BTL)
        registers_BRW = self.registers_NW.expand(len(tokens_BTW), -1, -1)
        x_BNW = torch.cat([registers_BRW, tokens_BTW], dim=1).to(dtype_of(self.layers))
        rotation = world_rotation(self.rotary, places)
        keys: Keys = places.is_key_BN
        if packing is not None:
            x_BNW = pack_tokens(x_BNW, packing)[None]
            keys = packing.sequences
            rotation = packed_rotation(rotation, packing)
        due_BNW = None
        for layer in self.layers:
            x_BNW, due_BNW = run_layer(
                layer, x_BNW, due_BNW, rotation, keys, recompute=self.recompute
            )
        return x_BNW if due_BNW is None else x_BNW + due_BNW


ELU_ALPHA = 1e-3
"""Slope of the output's ELU, as published: a picture's radiance stays above -0.0023."""

TOKEN_STD = 0.02
"""Standard deviation of the initial learned tokens, which are added to terms of unit size."""


class RenderFormer(nn.Module):
    """Network from triangles, materials and cameras to pictures.

    It is exactly invariant to translation of the world and permutation of triangles, and has to
    learn all other symmetries: rotation, mirroring and the order of a triangle's vertices.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.tf32 = False
        rotary = TriangleRotary(
            num_freqs=config.rope_num_freqs,
            max_freq=config.rope_max_freq,
            head_width=config.head_width,
        )
        self.encoder: Any = TriangleEncoder(config, rotary) if config.scene_tokens else None
        stage = HitDecoder if config.traces_hits else ViewDecoder
        self.decoder: Any = stage(config, rotary)

    def forward(self, batch: SceneBatch, resolution: int) -> Tensor:
        """Return log10(1 + radiance) [B, V, R, R, 3] before the ELU, as the loss uses it.

        Raises:
            TrilightError: the resolution is not a multiple of `config.picture_px`, or the network
                does not support the sky of a scene.
        """
        traced = batch.traced
        if (traced if self.config.traces_hits else batch.albedo_BVRR6) is None:
            return self.decode(self.encode(batch), batch, resolution)
        if traced is None or not self.config.traces_hits:
            encoded = self._encode_scenes(batch)
            return self.decode(encoded, batch, resolution, batch.albedo_BVRR6)
        self.config.require_resolution(resolution)
        encoded = self._encode_scenes(batch, (), traced.sides_T12, traced.unit_3)
        return self.decode_traced(encoded, traced)

    def encode(self, batch: SceneBatch) -> EncodedScene:
        """Return the encoded scenes of a batch; its cameras are ignored."""
        scenes = lit_scenes(batch) if self.config.hit_rays else ()
        if not self.config.traces_hits:
            return self._encode_scenes(batch, scenes)
        sides_BT12 = pad_sequence([as_tensor(each.light.sides_T12) for each in scenes], True)
        units_B3 = torch.stack([as_tensor(each.light.mean_3) for each in scenes])
        light = (like(each, batch.triangles_BT33) for each in (sides_BT12, units_B3))
        scenes = tuple(each.on_device(batch.triangles_BT33.device) for each in scenes)
        return self._encode_scenes(batch, scenes, *light)

    def _encode_scenes(
        self,
        batch: SceneBatch,
        surfaces: tuple[LitScene, ...] = (),
        sides_BT12: Tensor | None = None,
        unit_B3: Tensor | None = None,
    ) -> EncodedScene:
        """Encode scenes by the view-independent stage, if there is one."""
        for sky in batch.skies or ():
            require_known_sky(sky, self.config)
        places = token_positions(
            batch.triangles_BT33,
            batch.is_triangle_BT,
            num_registers=self.config.num_registers,
            eps=self.config.register_eps,
            num_triangles=batch.num_triangles,
        )
        keys_values: tuple[KeysValues, ...] = ()
        packing = None
        if self.encoder is not None:
            layer_weight = next(self.encoder.layers.parameters())
            packing = places.packing(layer_weight, self.config.head_width)
            if sides_BT12 is not None and unit_B3 is not None:
                sides_BT12 = sides_BT12 / unit_B3.repeat(1, 4)[:, None]
                batch = in_light_units(batch, unit_B3)
            with tf32(self.tf32):
                context_BNW = self.encoder(batch, places, sides_BT12, packing)
                keys_values = self.decoder.keys_values(context_BNW, places, packing)
        return EncodedScene(
            places=places, keys_values=keys_values, packing=packing, surfaces=surfaces
        )

    def decode(
        self,
        scene: EncodedScene,
        cameras: Cameras,
        resolution: int,
        albedo_BVRR6: Tensor | None = None,
    ) -> Tensor:
        """Return the pictures [B, V, R, R, 3] of any views of encoded scenes.

        On a CPU, decoding views one by one is as fast as together, in half the memory.

        Args:
            scene: result of `encode`.
            cameras: cameras of B scenes by V views.
            resolution: a multiple of `config.picture_px`.
            albedo_BVRR6: of visible surfaces, for a demodulated network; None traces it.

        Raises:
            TrilightError: the resolution is no such multiple.
        """
        self.config.require_resolution(resolution)
        if self.config.traces_hits:
            traced = self.trace(scene, cameras, resolution)
            return self.decode_traced(scene, denoise_traced(traced, self.config))
        rays = self.config.hit_rays
        if rays and albedo_BVRR6 is None:
            albedo_BVRR6 = albedo_of_cameras(scene.surfaces, cameras, resolution, rays)
        with tf32(self.tf32):
            picture_BVRRC: Tensor = self.decoder(scene, cameras, resolution)
        if albedo_BVRR6 is None:
            return picture_BVRRC
        return compose_radiance(picture_BVRRC, albedo_BVRR6)

    def trace(self, scene: EncodedScene, cameras: Cameras, resolution: int) -> Traced:
        """Return the traced inputs of views, for `hits`; arguments are as of `decode`."""
        with tf32(self.tf32):
            return traced_cameras(scene.surfaces, cameras, resolution, self.config)

    def decode_traced(self, scene: EncodedScene, traced: Traced) -> Tensor:
        """Return the pictures [B, V, R, R, 3] of traced views, denoised where the network asks."""
        with tf32(self.tf32):
            pictures: Tensor = self.decoder(scene, traced)
        return pictures

    def recompute_activations(self, enabled: bool) -> None:
        """Set whether activations are recomputed in the backward pass; by default they are kept."""
        self.decoder.recompute = enabled
        if self.encoder is not None:
            self.encoder.recompute = enabled

    def initialize(self, generator: torch.Generator) -> None:
        """Initialize all weights: Xavier for matrices, small tokens, a black picture."""
        for module in self.modules():
            if isinstance(module, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(module.weight, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        tokens: list[nn.Parameter] = []
        if self.encoder is not None:
            tokens += [self.encoder.tokens.token_W, self.encoder.registers_NW]
        if isinstance(self.decoder, ViewDecoder):
            tokens.append(self.decoder.token_W)
        for token in tokens:
            nn.init.normal_(token, std=TOKEN_STD, generator=generator)
        # A black picture is a safe start only because the loss is taken before the ELU: after it, a
        # start at 0 has a thousandth of the gradient on one side, and most runs stay black.
        nn.init.zeros_(self.decoder.head.last.weight)
        nn.init.zeros_(self.decoder.head.last.bias)


def radiance(log10_rgb: Tensor) -> Tensor:
    """Return the linear radiance of the network's output: ELU, then 10^x - 1.

    For pictures only. The ELU's slope is a thousandth below 0, so that with a loss after it a dark
    network hardly recovers.
    """
    return torch.pow(10.0, nn.functional.elu(log10_rgb, alpha=ELU_ALPHA)) - 1.0


def count_parameters(model: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(weight.numel() for weight in model.parameters())
