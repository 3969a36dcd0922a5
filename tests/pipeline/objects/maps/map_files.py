"""Files of textures and maps for tests, written byte by byte or by the libraries that read them."""

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.records.exr import encode_channels


def png(path: Path, texels: NDArray[np.uint8]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(texels).save(path)
    return path


def noise(seed: int, height: int = 4, width: int = 4) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def exr(path: Path, radiance: NDArray[np.float32]) -> Path:
    path.write_bytes(encode_channels({"RGB": np.ascontiguousarray(radiance, np.float32)}))
    return path


def sun_map(seed: int = 0, rows: int = 8) -> NDArray[np.float32]:
    radiance = np.random.default_rng(seed).random((rows, 2 * rows, 3)).astype(np.float32)
    radiance[rows // 3, rows] = 1e6
    return radiance


def hdr(texels: NDArray[np.uint8], *, runs: bool, header: str = "") -> bytes:
    """Return a Radiance picture of mantissas and exponents [H, W, 4]."""
    rows, columns = texels.shape[:2]
    out = io.BytesIO()
    out.write(f"#?RADIANCE\n{header}FORMAT=32-bit_rle_rgbe\n\n-Y {rows} +X {columns}\n".encode())
    for row in texels:
        if not runs:
            out.write(row.tobytes())
            continue
        out.write(bytes([2, 2, columns >> 8, columns & 255]))
        for channel in range(4):
            at = 0
            while at < columns:
                values = row[at : at + 127, channel]
                if (values == values[0]).all():
                    out.write(bytes([128 + len(values), values[0]]))
                else:
                    out.write(bytes([len(values)]) + values.tobytes())
                at += len(values)
    return out.getvalue()
