"""Reads textures of a USD material: pictures with color space, channel, scale and wrap modes.

Without a scale, the bytes of a picture stay unchanged. A stated color space is used; without one,
colors in 8 bits are sRGB-encoded, as USD specifies.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES, Pixels, decode_pixels, is_encoded
from pipeline.exchange.wrapping import Wrap
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import TextureNode, UvChart, asset_bytes
from storage.records.texture import MapSource, Texture

_STEPS = 8
"""Number of points along an edge of the grid over a triangle; (8 + 1) 8 / 2 in all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignTexture:
    """A picture with the settings of its texture node."""

    pixels: Pixels
    """[H, W, 1 to 4] as stored, the bottom row first."""
    is_srgb: bool
    """True where colors are sRGB-encoded; alpha is always linear."""
    wrap: tuple[Wrap, Wrap]
    """Wrap modes along s and t."""
    scale: NDArray[np.float32]
    """[4] factors of the linear RGBA values."""
    bias: NDArray[np.float32]
    """[4] offsets that are added after `scale`."""
    chart: UvChart
    """Texture coordinates at which the picture is looked up."""
    output: str
    """Connected output of the node: rgb, r, g, b or a."""

    def texture(self, channels: int, source: MapSource, lost: list[str]) -> Texture:
        """Return the connected output as a texture of one or three channels.

        The wrap modes of the picture are not applied yet.
        """
        is_plain = (self.scale == 1).all() and (self.bias == 0).all()
        if self.pixels.dtype == np.uint8 and is_plain:
            chosen = _channels(self.pixels, self.output, channels, 255)
            is_srgb = self.is_srgb and not self._is_alpha
            return Texture(texels=np.ascontiguousarray(chosen), is_srgb=is_srgb, source=source)
        values = _channels(self._scale_texels(), self.output, channels, 1)
        if not (values.min() >= 0 and values.max() <= 1):  # or NaN
            lost.append("texels outside [0, 1]: clamped, and NaN replaced by 0")
            values = np.clip(np.nan_to_num(values, nan=0.0), 0, 1)
        return Texture(texels=np.ascontiguousarray(values, np.float32), source=source)

    def means(self, uv: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the means [T, 3] over triangles with coordinates [T, 3, 2], at 36 points each."""
        points = np.einsum("pk,tkc->tpc", _grid(), uv)
        height, width = self.pixels.shape[:2]
        columns = _wrap_texels(points[..., 0], width, self.wrap[0])
        rows = _wrap_texels(points[..., 1], height, self.wrap[1])
        values = _channels(self._scale_texels(), self.output, 3, 1)
        means: NDArray[np.float32] = np.nan_to_num(values[rows, columns].mean(axis=1), nan=0.0)
        return means.astype(np.float32)

    @property
    def _is_alpha(self) -> bool:
        return self.output == "a"

    def _scale_texels(self) -> NDArray[np.float32]:
        """Return linear RGBA values [H, W, 4] with scale and bias applied."""
        values = self.pixels.astype(np.float32)
        if self.pixels.dtype == np.uint8:
            values = values / np.float32(255)
        count = values.shape[2]
        rgba = np.ones((*values.shape[:2], 4), np.float32)
        rgba[..., :3] = values[..., :3] if count >= 3 else values[..., :1]
        if self.is_srgb:
            rgba[..., :3] = _linear(rgba[..., :3])
        if count in (2, 4):
            rgba[..., 3] = values[..., -1]
        return rgba * self.scale + self.bias


def read_texture(node: TextureNode, opened: OpenedStage) -> ForeignTexture | None:
    """Read the texture of a node; return None, with a note, where its picture is unreadable.

    Raises:
        TrilightError: the picture is too large.
    """
    data = None if node.resolved is None else asset_bytes(node.resolved, MAX_BYTES)
    name = Path(node.named).name
    is_color = node.color_space != "raw"
    pixels = decode_pixels(data, name, opened.lost, is_color=is_color) if data else None
    if pixels is None:
        opened.lost.append(
            f"texture {node.named!r:.100}: missing or not readable as a picture"
            if node.named
            else "a texture without a file"
        )
        return None
    space = node.color_space
    return ForeignTexture(
        pixels=pixels[::-1],
        is_srgb=is_encoded(pixels) if space not in ("sRGB", "raw") else space == "sRGB",
        wrap=node.wrap,
        scale=node.scale,
        bias=node.bias,
        chart=node.chart,
        output=node.output,
    )


def _channels(values: NDArray, output: str, channels: int, opaque: int) -> NDArray:
    """Return one or three channels [H, W, 1 or 3] of a picture for the connected output."""
    count = values.shape[2]
    if output == "a":
        alpha = values[..., -1:] if count in (2, 4) else np.full_like(values[..., :1], opaque)
        return np.repeat(alpha, channels, axis=-1)
    if output == "rgb" and channels == 3 and count >= 3:
        return values[..., :3]
    row = "rgb".index(output) if output in ("r", "g", "b") and count >= 3 else 0
    return np.repeat(values[..., row : row + 1], channels, axis=-1)


def _linear(encoded: NDArray[np.float32]) -> NDArray[np.float32]:
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def _wrap_texels(at: NDArray[np.float64], size: int, mode: str) -> NDArray[np.int64]:
    """Return the texel index at coordinates; `black` is treated as `clamp`."""
    if mode == "mirror":
        at = 1 - np.abs(np.mod(at, 2) - 1)
    elif mode in ("clamp", "black"):
        at = np.clip(at, 0, 1)
    else:
        at = np.mod(at, 1)
    return np.minimum((at * size).astype(np.int64), size - 1)


def _grid() -> NDArray[np.float64]:
    """Return barycentric coordinates [P, 3] of points spread evenly over a triangle."""
    rows = [(i, j) for i in range(_STEPS) for j in range(_STEPS - i)]
    u, v = (np.array(rows, np.float64).T + 1 / 3) / _STEPS
    return np.stack([u, v, 1 - u - v], axis=1)
