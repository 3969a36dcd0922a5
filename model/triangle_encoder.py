"""View-independent stage (encoder): light transport between triangles, once per scene.

Every triangle is one token: the sum of a learned vector, its material and its normals. Its position
enters only through rotary encodings. Registers are at the mean of all vertices.
"""

import torch
from torch import Tensor, nn

from model.attention import Keys
from model.config import HitStage, ModelConfig
from model.encoded_scene import TokenPositions
from model.layers import TOKEN_NORM_EPS, EncoderLayer, Norm, dtype_of, run_layer
from model.packing import Packing, pack_tokens
from model.positions import (
    TriangleRotary,
    encode_normals,
    encoded_normal_width,
    packed_rotation,
    world_rotation,
)
from model.precision import without_autocast
from model.scene_tensors import SceneBatch
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
        by_hits = isinstance(config.stage, HitStage)
        self.light = nn.Linear(SIDE_LIGHTS, config.width) if by_hits else None

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
