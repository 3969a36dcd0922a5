"""Converts the pictures of a texture to albedos and roughness.

The base color is sRGB-encoded, all else is linear. Means are of linear values; the mean of
roughness is that of the GGX width, its square. There is no Fresnel term here: a surface with a
metallic map, or with a base color alone, gets its albedos from storage.records.fresnel.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.maps.resample import area_means
from storage.records.fresnel import constant_albedos
from storage.records.texture import content_digest


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureSet:
    """A user's texture, ready for scenes; the top row first."""

    diffuse_rgb: NDArray[np.float32]
    """[H, W, 3] linear diffuse albedo."""
    specular_rgb: NDArray[np.float32]
    """[H, W, 3] specular albedo; with the diffuse albedo at most 1 in each channel."""
    roughness: NDArray[np.float32] | None
    """[H, W, 1] roughness; None without a picture of it: scenes then draw one number."""
    content_sha256: str
    """Digest of the base color as read: copies share it, whatever their other pictures."""


def texture_set(pictures: Mapping[str, NDArray[np.float32]], size: int) -> TextureSet:
    """Return the maps of a texture.

    Args:
        pictures: encoded values [H, W, 1 or 3] of the component "base", and of "specular",
            "roughness" and "metallic" where present. They may differ in size.
        size: most texels along a side of the result.
    """
    base = pictures["base"]
    height, width = _fitting_size(base.shape[:2], size)

    def means(values: NDArray) -> NDArray[np.float64]:
        return area_means(values, height, width)

    color = _three(means(_linear(base)))
    metallic = means(_grey(pictures["metallic"])) if "metallic" in pictures else np.zeros(1)
    if "specular" in pictures:
        diffuse = color * (1 - metallic)
        # where both are over 1, the lobe gives way
        specular = np.minimum(_three(means(pictures["specular"])), 1 - diffuse)
    else:
        diffuse, specular = constant_albedos(color, metallic)
        specular = np.broadcast_to(specular, diffuse.shape)
    roughness = None
    if "roughness" in pictures:
        roughness = np.sqrt(means(np.square(_grey(pictures["roughness"]))))
    return TextureSet(
        diffuse_rgb=diffuse.astype(np.float32),
        specular_rgb=np.ascontiguousarray(specular, np.float32),
        roughness=None if roughness is None else roughness.astype(np.float32),
        content_sha256=content_digest("base colour", base),
    )


def _fitting_size(shape: tuple[int, ...], size: int) -> tuple[int, int]:
    """Return height and width with the proportions of a picture and no side over `size`."""
    shrink = min(1.0, size / max(shape))
    height, width = (max(1, round(side * shrink)) for side in shape)
    return height, width


def _linear(encoded: NDArray[np.float32]) -> NDArray[np.float32]:
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def _grey(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values.mean(axis=2, keepdims=True, dtype=np.float32)


def _three(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values
