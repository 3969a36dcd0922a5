"""Textures of a USD material, averaged over each triangle in linear light.

A `Scene` has one colour a triangle. A triangle takes the mean of its texture at 36 points spread
evenly over it; how far the texels lie from that mean is what is lost, and is said.
"""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.stage import OpenedUsd
from storage.errors import TrilightError

MAX_BYTES = 256 << 20
MAX_PIXELS = 64 << 20
"""Maximum size of one picture."""

_STEPS = 8
"""Points along an edge of the grid over a triangle; (8 + 1) 8 / 2 of them in all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignTexture:
    """A picture as a material uses it."""

    linear: NDArray[np.float32]  # [H, W, C] linear values, row 0 on top
    wrap: tuple[str, str]  # USD's wrap modes along s and t
    scale: NDArray[np.float32]  # [4]
    bias: NDArray[np.float32]  # [4]
    primvar: str  # name of the texture coordinates
    output: str  # rgb, r, g, b or a: what is connected

    def means(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.float32], float]:
        """Return the mean [T, 3] over triangles with coordinates [T, 3, 2], and the deviation.

        The deviation is the root mean square distance of a sample from its triangle's mean.
        """
        points = np.einsum("pk,tkc->tpc", _grid(), uv)
        columns = _wrapped(points[..., 0], self.linear.shape[1], self.wrap[0])
        rows = _wrapped(1 - points[..., 1], self.linear.shape[0], self.wrap[1])
        texels = self._channels(self.linear[rows, columns])
        mean = texels.mean(axis=1)
        spread = float(np.sqrt(np.square(texels - mean[:, None]).mean())) if len(texels) else 0.0
        return mean.astype(np.float32), spread

    def _channels(self, texels: NDArray[np.float32]) -> NDArray[np.float32]:
        count = texels.shape[-1]
        whole = np.ones((*texels.shape[:-1], 4), np.float32)
        if count < 3:
            whole[..., :3] = texels[..., :1]
        else:
            whole[..., : min(count, 4)] = texels[..., :4]
        whole = whole * self.scale + self.bias
        if self.output == "rgb":
            return whole[..., :3]
        return np.repeat(whole[..., ["rgba".index(self.output)]], 3, axis=-1)


def read_texture(shader: Any, output: str, time: Any, opened: OpenedUsd) -> ForeignTexture | None:
    """Return the texture of a UsdUVTexture shader, or None, with a note, if unreadable.

    Raises:
        TrilightError: its file is outside of the folder or on the network.
    """
    attribute = shader.GetInput("file")
    asset = attribute.Get(time) if attribute else None
    if asset is None or not asset.path:
        opened.lost.append(f"{shader.GetPath()}: a texture without a file")
        return None
    spec = attribute.GetAttr().GetPropertyStack(time)
    layer = spec[0].layer if spec else opened.root
    found = opened.inside(layer, asset.path)
    pixels = None if found is None else _pixels(found)
    if pixels is None:
        opened.lost.append(f"texture {asset.path!r:.100}: missing or not readable as a picture")
        return None
    space = _get(shader, "sourceColorSpace", time, "auto")
    linear = _linear(pixels) if space != "raw" and pixels.shape[2] >= 3 else pixels
    return ForeignTexture(
        linear=linear,
        wrap=(
            str(_get(shader, "wrapS", time, "repeat")),
            str(_get(shader, "wrapT", time, "repeat")),
        ),
        scale=np.array(_get(shader, "scale", time, (1, 1, 1, 1)), np.float32),
        bias=np.array(_get(shader, "bias", time, (0, 0, 0, 0)), np.float32),
        primvar=_primvar(shader, time, opened.lost),
        output=output if output in ("r", "g", "b", "a") else "rgb",
    )


def _primvar(shader: Any, time: Any, lost: list[str]) -> str:
    """Return the name of the coordinates that a texture reads."""
    st = shader.GetInput("st")
    for _ in range(8):
        source = st.GetConnectedSources()[0] if st and st.HasConnectedSource() else []
        if not source:
            break
        reader = source[0].source.GetPrim()
        from pxr import UsdShade

        node = UsdShade.Shader(reader)
        if node.GetIdAttr().Get() == "UsdTransform2d":
            lost.append(f"{reader.GetPath()}: texture coordinates are moved; they were taken as is")
            st = node.GetInput("in")
            continue
        name = node.GetInput("varname")
        value = UsdShade.Utils.GetValueProducingAttributes(name) if name else []
        if value:
            return str(value[0].Get(time))
        break
    return "st"


def _get(shader: Any, name: str, time: Any, default: Any) -> Any:
    attribute = shader.GetInput(name)
    value = attribute.Get(time) if attribute else None
    return default if value is None else value


def _pixels(resolved: str) -> NDArray[np.float32] | None:
    """Return a picture [H, W, C] of values in [0, 1]; None where it is none."""
    from PIL import Image

    name = Path(resolved).name
    data = asset_bytes(resolved)
    if data is None:
        return None
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "BMP", "TGA")) as image:
            if image.width * image.height > MAX_PIXELS:
                raise TrilightError(f"{name}: expected at most {MAX_PIXELS} pixels.")
            if image.mode.startswith("I;16") or image.mode == "I":
                return (np.asarray(image, np.float32) / np.float32(65535))[..., None]
            mode = image.mode if image.mode in ("L", "RGB", "RGBA") else "RGB"
            values = np.asarray(image.convert(mode), np.float32) / np.float32(255)
    except TrilightError:
        raise
    except (OSError, SyntaxError, ValueError, LookupError, Image.DecompressionBombError):
        return None  # PIL says so in all of these ways
    return values if values.ndim == 3 else values[..., None]


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


def _linear(encoded: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return values whose colour channels were sRGB-encoded as linear ones; alpha stays."""
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    linear[..., 3:] = encoded[..., 3:]
    return linear.astype(np.float32)


def _wrapped(at: NDArray[np.float64], size: int, mode: str) -> NDArray[np.int64]:
    """Return the texel of coordinates; `black` is treated as `clamp`."""
    finite = np.nan_to_num(at, nan=0.0, posinf=0.0, neginf=0.0)
    if mode == "mirror":
        finite = 1 - np.abs(np.mod(finite, 2) - 1)
    elif mode in ("clamp", "black"):
        finite = np.clip(finite, 0, 1)
    else:
        finite = np.mod(finite, 1)
    return np.minimum((finite * size).astype(np.int64), size - 1)


def _grid() -> NDArray[np.float64]:
    """Return barycentric coordinates [P, 3] of points spread evenly over a triangle."""
    rows = [(i, j) for i in range(_STEPS) for j in range(_STEPS - i)]
    u, v = (np.array(rows, np.float64).T + 1 / 3) / _STEPS
    return np.stack([u, v, 1 - u - v], axis=1)
