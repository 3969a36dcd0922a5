"""Several pictures in one OpenEXR file: layers, whose channels are `<layer>.R`, `.G` and `.B`."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from storage.records.exr import (
    Attributes,
    decode_channels,
    decode_exr,
    encode_channels,
    encode_exr,
    to_half,
)


def encode_layers(names: Sequence[str], radiance_rgb: NDArray[np.float32]) -> bytes:
    """Return the OpenEXR file of pictures [N, R, R, 3] by the names of their layers.

    Raises:
        TrilightError: a value is not finite, negative, or too large for a half float.
    """
    return encode_channels(_channels(names, radiance_rgb))


def encode_picture(
    radiance_rgb: NDArray[np.float32],
    layers_rgb: Mapping[str, NDArray[np.float32]],
    attributes: Attributes,
) -> bytes:
    """Return the OpenEXR file of a picture [R, R, 3] and of its layers.

    Raises:
        TrilightError: as `storage.records.exr.encode_exr`.
    """
    if not layers_rgb:
        return encode_exr(radiance_rgb, attributes=attributes)
    layers = _channels(tuple(layers_rgb), np.stack(list(layers_rgb.values())))
    return encode_channels({"RGB": to_half(radiance_rgb), **layers}, attributes=attributes)


def decode_picture(data: bytes, layers: Collection[str]) -> NDArray[np.float32]:
    """Return the picture [H, W, 3] of a file, without its layers of these names.

    Raises:
        TrilightError: as `storage.records.exr.decode_exr`.
    """
    if not layers:
        return decode_exr(data)
    names = ["R", "G", "B", *(f"{layer}.{channel}" for layer in layers for channel in "RGB")]
    by_channel = decode_channels(data, names, separate=True)
    return np.stack([by_channel[channel] for channel in "RGB"], axis=-1).astype(np.float32)


def _channels(
    names: Sequence[str], radiance_rgb: NDArray[np.float32]
) -> dict[str, NDArray[np.float16]]:
    return {
        f"{name}.{channel}": np.ascontiguousarray(picture[..., index])
        for name, picture in zip(names, to_half(radiance_rgb), strict=True)
        for index, channel in enumerate("RGB")
    }


def decode_layers(
    data: bytes, names: Sequence[str], size: tuple[int, int], what: str
) -> NDArray[np.float32]:
    """Return the pictures of an OpenEXR file, float32 [N, H, W, 3].

    Args:
        data: the file.
        names: of the layers as they must be.
        size: H and W as they must be.
        what: the pictures in messages.

    Raises:
        TrilightError: not an EXR file, truncated, or with other channels or another size.
    """
    channels = [f"{name}.{channel}" for name in names for channel in "RGB"]
    by_channel = decode_channels(data, channels, size=size, what=what, separate=True)
    planes = np.stack([np.asarray(by_channel[name], np.float32) for name in channels])
    return np.moveaxis(planes.reshape(len(names), 3, *size), 1, -1).copy()
