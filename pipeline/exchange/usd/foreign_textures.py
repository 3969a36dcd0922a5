"""Textures of a USD material: pictures with their colour space, channel, scale and wrapping.

Where nothing is scaled, the bytes of a picture stay as they are. What a colour space says is taken
as said; without one, colours in 8 bits are sRGB-encoded, as USD states.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES, Pixels, decoded_pixels, is_encoded
from pipeline.exchange.usd.foreign_coordinates import UvChart, chart_of, value_of
from pipeline.exchange.usd.stage import OpenedUsd
from pipeline.exchange.wrapping import Wrap
from storage.errors import TrilightError
from storage.records.texture import MapSource, Texture

_STEPS = 8
"""Points along an edge of the grid over a triangle; (8 + 1) 8 / 2 of them in all."""

_WRAPS = ("repeat", "mirror", "clamp", "black")


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignTexture:
    """A picture as a material uses it."""

    pixels: Pixels
    """[H, W, 1 to 4] as stored, the bottom row first."""
    is_srgb: bool
    """Whether its colours are sRGB-encoded; alpha is not."""
    wrap: tuple[Wrap, Wrap]
    """Wrap modes along s and t."""
    scale: NDArray[np.float32]
    """[4]"""
    bias: NDArray[np.float32]
    """[4]"""
    chart: UvChart
    """Where it is looked up."""
    output: str
    """rgb, r, g, b or a: what is connected."""

    def texture(self, channels: int, source: MapSource, lost: list[str]) -> Texture:
        """Return what is connected, as a texture of one or of three channels.

        It does not repeat yet as the picture wraps.
        """
        is_plain = (self.scale == 1).all() and (self.bias == 0).all()
        if self.pixels.dtype == np.uint8 and is_plain:
            chosen = _channels(self.pixels, self.output, channels, 255)
            is_srgb = self.is_srgb and not self._is_alpha
            return Texture(texels=np.ascontiguousarray(chosen), is_srgb=is_srgb, source=source)
        values = _channels(self._scaled(), self.output, channels, 1)
        if not (values.min() >= 0 and values.max() <= 1):  # or NaN
            lost.append("texels that are no number from 0 to 1: they were clamped, NaN to 0")
            values = np.clip(np.nan_to_num(values, nan=0.0), 0, 1)
        return Texture(texels=np.ascontiguousarray(values, np.float32), source=source)

    def means(self, uv: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the means [T, 3] over triangles with coordinates [T, 3, 2], at 36 points each."""
        points = np.einsum("pk,tkc->tpc", _grid(), uv)
        height, width = self.pixels.shape[:2]
        columns = _wrapped(points[..., 0], width, self.wrap[0])
        rows = _wrapped(points[..., 1], height, self.wrap[1])
        values = _channels(self._scaled(), self.output, 3, 1)
        means: NDArray[np.float32] = np.nan_to_num(values[rows, columns].mean(axis=1), nan=0.0)
        return means.astype(np.float32)

    @property
    def _is_alpha(self) -> bool:
        return self.output == "a"

    def _scaled(self) -> NDArray[np.float32]:
        """Return linear values [H, W, 4], scaled and moved."""
        values = self.pixels.astype(np.float32)
        if self.pixels.dtype == np.uint8:
            values = values / np.float32(255)
        count = values.shape[2]
        whole = np.ones((*values.shape[:2], 4), np.float32)
        whole[..., :3] = values[..., :3] if count >= 3 else values[..., :1]
        if self.is_srgb:
            whole[..., :3] = _linear(whole[..., :3])
        if count in (2, 4):
            whole[..., 3] = values[..., -1]
        return whole * self.scale + self.bias


def read_texture(
    shader: Any, output: str, time: Any, opened: OpenedUsd
) -> ForeignTexture | NDArray[np.float64] | None:
    """Return the texture of a UsdUVTexture shader.

    Where it is not readable, a note says so, and its `fallback` [4] is returned if it states one;
    else None.

    Raises:
        TrilightError: its file is outside of the folder or on the network, or too large.
    """
    attribute = shader.GetInput("file")
    asset = attribute.Get(time) if attribute else None
    named = "" if asset is None else asset.path
    pixels = None
    if named:
        specs = attribute.GetAttr().GetPropertyStack(time)
        found = opened.inside(specs[0].layer if specs else opened.root, named)
        data = None if found is None else asset_bytes(found)
        pixels = None if data is None else decoded_pixels(data, Path(named).name)
    if pixels is None:
        opened.lost.append(
            f"texture {named!r:.100}: missing or not readable as a picture"
            if named
            else f"{shader.GetPath()}: a texture without a file"
        )
        fallback = value_of(shader, "fallback", time, None)
        return None if fallback is None else np.array(fallback, np.float64)
    space = str(value_of(shader, "sourceColorSpace", time, "auto"))
    is_srgb = is_encoded(pixels) if space not in ("sRGB", "raw") else space == "sRGB"
    return ForeignTexture(
        pixels=pixels[::-1],
        is_srgb=is_srgb,
        wrap=(_wrap(shader, "wrapS", time), _wrap(shader, "wrapT", time)),
        scale=np.array(value_of(shader, "scale", time, (1, 1, 1, 1)), np.float32),
        bias=np.array(value_of(shader, "bias", time, (0, 0, 0, 0)), np.float32),
        chart=chart_of(shader, time),
        output=output if output in ("r", "g", "b", "a") else "rgb",
    )


def asset_bytes(resolved: str) -> bytes | None:
    """Return the bytes of a plain file, or of a member of an archive; None where there are none."""
    name = Path(resolved).name
    outer, _, member = resolved.partition("[")
    try:
        if member:
            with zipfile.ZipFile(outer) as archive:
                return archive.read(member.rstrip("]"))
        if Path(outer).stat().st_size > MAX_BYTES:
            raise TrilightError(f"{name}: expected at most {MAX_BYTES} bytes.")
        return Path(outer).read_bytes()
    except (OSError, KeyError, zipfile.BadZipFile):
        return None


def _wrap(shader: Any, name: str, time: Any) -> Wrap:
    """Return a wrap mode; `useMetadata` and what is unknown repeat."""
    mode = str(value_of(shader, name, time, "repeat"))
    return cast(Wrap, mode) if mode in _WRAPS else "repeat"


def _channels(values: NDArray, output: str, channels: int, opaque: int) -> NDArray:
    """Return one or three channels [H, W, 1 or 3] of a picture for what is connected."""
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


def _wrapped(at: NDArray[np.float64], size: int, mode: str) -> NDArray[np.int64]:
    """Return the texel of coordinates; `black` is treated as `clamp`."""
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
