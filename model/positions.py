"""Position encodings of tokens, and encoded scenes: the output of the view-independent stage.

Queries and keys are rotated by angles proportional to the nine vertex coordinates (RoPE), so that
their product depends only on differences of positions: the network is invariant to translation
(Zeng et al. 2025, section 3.1), but not to rotation. Normals enter by their sines.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from model.attention import Keys, Packing, pack_lengths, pack_tokens, supports_packed

if TYPE_CHECKING:
    from model.hits.lit_scene import LitScene


KeysValues = tuple[Tensor, Tensor]
"""Keys, not yet rotated into a camera, and values of one layer; [B, H, N, D] each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TokenPositions:
    """Positions of the tokens of scenes: registers first, then triangles."""

    positions_BN33: Tensor
    """Three vertices each, world space; a register stands at the mean vertex, three times over."""
    scale_BN11: Tensor
    """Factor of the positions in any frame: 1 except for published registers, whose mean divides by
    slightly more than the number of triangles."""
    is_key_BN: Tensor | None
    """bool, False in the padding; None where nothing is padded."""
    lengths: tuple[int, ...] | None = None
    """Number of tokens of each padded scene, as in `is_key_BN`, but known to the host without a
    wait for the device; None if unknown."""

    def packing(self, x: Tensor, head_width: int) -> Packing | None:
        """Return the packing of the tokens, or None if attention uses masks.

        Args:
            x: tensor with the device and type of the attention.
        """
        if self.lengths is None or not supports_packed(x, head_width):
            return None
        return pack_lengths(self.lengths, self.positions_BN33.shape[1], x.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedScene:
    """A batch of encoded scenes, for any number of views.

    Keys are stored before their rotation, since that depends on the camera.
    """

    places: TokenPositions
    """Positions of all tokens, registers included."""
    keys_values: tuple[KeysValues, ...]
    """Keys and values for each layer of the view stage; for `hits`, keys are rotated into world
    space."""
    packing: Packing | None = None
    """Packing of the tokens, scene after scene in one row [1, H, P, D]; None for padded scenes."""
    surfaces: "tuple[LitScene, ...]" = ()
    """Scenes ready for rays, for `hits` and demodulated bundles; empty if views are traced already.
    """

    def keys(self, views: int = 1) -> Keys:
        """Return the valid keys; packed ones are repeated for each view, view after view."""
        return self.places.is_key_BN if self.packing is None else self.packing.of_views(views)


Rotation = tuple[Tensor, Tensor]
"""cos and sin [..., N, D / 2]."""


class TriangleRotary(nn.Module):
    """Rotary angles of triangles: coordinate x frequency, coordinate-major, without a factor 2 pi.

    The frequencies are not in the state dict, since the configuration determines them. Positions
    must be float32 or better: rounding them costs 60 dB and more.
    """

    freqs_F: Tensor

    def __init__(self, *, num_freqs: int, max_freq: float, head_width: int) -> None:
        super().__init__()
        self.num_freqs = num_freqs
        self.max_freq = max_freq
        self.half_width = head_width // 2
        self.register_buffer("freqs_F", None, persistent=False)
        self.reset()

    def reset(self) -> None:
        """Compute the frequencies again in float32, after a cast or the meta device.

        They are log2-spaced as in the published code, and exactly equal to its own.
        """
        octaves_F = torch.linspace(0, math.log2(self.max_freq), self.num_freqs)
        self.freqs_F = 2**octaves_F

    def forward(self, triangles_N33: Tensor) -> Rotation:
        """Return (cos, sin) [..., N, D / 2] of vertex positions [..., N, 3, 3].

        Angles beyond the first 9 x num_freqs are 0: those pairs are not rotated.
        """
        coordinates_N9 = triangles_N33.flatten(-2)
        angles_NA = (coordinates_N9[..., None] * self.freqs_F).flatten(-2)
        angles_NA = nn.functional.pad(angles_NA, (0, self.half_width - angles_NA.shape[-1]))
        return angles_NA.cos(), angles_NA.sin()


def rotate(x_HND: Tensor, cos_NA: Tensor, sin_NA: Tensor) -> Tensor:
    """Rotate each pair (channel i, channel i + D / 2) of x [..., H, N, D] by its angle.

    cos and sin are [..., N, D / 2], equal for all heads. A half-precision x is rotated in the
    table's precision and rounded once, at the end. In memory the heads of a token stay together, as
    layers before and after attention have them, so that nothing is copied.
    """
    cos_N1A = cos_NA.unsqueeze(-2)
    sin_N1A = sin_NA.unsqueeze(-2)
    a, b = x_HND.transpose(-2, -3).chunk(2, dim=-1)
    rotated = torch.cat([a * cos_N1A - b * sin_N1A, b * cos_N1A + a * sin_N1A], dim=-1)
    return rotated.to(x_HND.dtype).transpose(-2, -3)


def encode_normals(normals_N33: Tensor, octaves: int) -> Tensor:
    """Return components, their sines and their cosines, [..., N, 9 + 18 octaves].

    Sines are of component x 2^k, component-major (NeRF, Mildenhall et al. 2020, equation 4,
    without its factor pi).
    """
    components_N9 = normals_N33.flatten(-2)
    scale_F = 2.0 ** torch.arange(octaves, dtype=components_N9.dtype, device=components_N9.device)
    phase_NF = (components_N9[..., None] * scale_F).flatten(-2)
    shifted_NF = phase_NF + math.pi / 2
    return torch.cat([components_N9, phase_NF.sin(), shifted_NF.sin()], dim=-1)


def encoded_normal_width(octaves: int) -> int:
    """Return the last dimension of the result of `encode_normals`."""
    return 9 + 18 * octaves


def to_camera(points_BT33: Tensor, c2w_BV44: Tensor) -> Tensor:
    """Return the points [B, V, T, 3, 3] in the space of each camera.

    The origin is subtracted before the rotation, so that a scene far from the world's origin loses
    no more digits than its coordinates already have. c2w must hold a rotation (Scene.check).
    Written as a sum, because autocast would round the operands of a matrix product to bfloat16.
    """
    relative_BVT33 = points_BT33[:, None] - c2w_BV44[:, :, None, None, :3, 3]
    rotation_BV1133 = c2w_BV44[:, :, None, None, :3, :3]
    return (relative_BVT33[..., None] * rotation_BV1133).sum(dim=-2)


def token_positions(
    triangles_BT33: Tensor,
    is_triangle_BT: Tensor | None,
    *,
    num_registers: int,
    eps: float,
    num_triangles: tuple[int, ...] | None = None,
) -> TokenPositions:
    """Return the positions of registers and triangles; `num_triangles` agrees with the mask.

    The published code divides the registers' sum of positions by T + 1e-5, in world space and again
    in each camera's space, which moves them towards the origin by 1e-5 / T of their distance. `eps`
    reproduces this for published weights; with 0 the network is exactly invariant to translation.
    """
    batch, longest = triangles_BT33.shape[:2]
    center_BT3 = triangles_BT33.mean(dim=-2)
    scale_BN11 = triangles_BT33.new_ones((batch, num_registers + longest, 1, 1))
    if is_triangle_BT is None:
        mean_B3 = center_BT3.mean(dim=1)
        count_B = scale_BN11.new_full((batch,), longest)
        is_key_BN = None
    else:
        weight_BT1 = is_triangle_BT[..., None].to(center_BT3.dtype)
        mean_B3 = (center_BT3 * weight_BT1).sum(dim=1) / weight_BT1.sum(dim=1)
        count_B = is_triangle_BT.sum(dim=1).to(scale_BN11.dtype)
        is_key_BN = nn.functional.pad(is_triangle_BT, (num_registers, 0), value=True)
    scale_BN11[:, :num_registers] = (count_B / (count_B + eps))[:, None, None, None]
    registers_BR33 = mean_B3[:, None, None, :].expand(-1, num_registers, 3, 3)
    return TokenPositions(
        positions_BN33=torch.cat([registers_BR33, triangles_BT33], dim=1),
        scale_BN11=scale_BN11,
        is_key_BN=is_key_BN,
        lengths=None if num_triangles is None else tuple(num_registers + n for n in num_triangles),
    )


def packed_rotation(rotation_BNA: Rotation, packing: Packing) -> Rotation:
    """Return the rotation [1, P, A] of packed tokens."""
    cos_BNA, sin_BNA = rotation_BNA
    return pack_tokens(cos_BNA, packing)[None], pack_tokens(sin_BNA, packing)[None]


def packed_camera_rotation(rotation_BVNA: Rotation, packing: Packing) -> Rotation:
    """Return the rotation [1, V, P, A] of packed tokens, in the space of each camera."""
    cos_BVNA, sin_BVNA = rotation_BVNA
    rotation = packed_rotation((cos_BVNA.transpose(1, 2), sin_BVNA.transpose(1, 2)), packing)
    return rotation[0].transpose(1, 2), rotation[1].transpose(1, 2)


def world_rotation(rotary: TriangleRotary, places: TokenPositions) -> Rotation:
    """Return the rotation [B, N, D / 2] of all tokens in world space."""
    return rotary(places.positions_BN33 * places.scale_BN11)


def camera_rotation(rotary: TriangleRotary, places: TokenPositions, c2w_BV44: Tensor) -> Rotation:
    """Return the rotation [B, V, N, D / 2] of all tokens in the space of each camera."""
    positions_BVN33 = to_camera(places.positions_BN33, c2w_BV44)
    return rotary(positions_BVN33 * places.scale_BN11[:, None])
