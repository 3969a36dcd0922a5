"""Converts passes to colors for display, never for measurement.

Black marks pixels that meet no surface. Every other gray and every id is brighter.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import srgb8
from storage.records.surfaces import MISS

_DARKEST = 40
"""Gray of the farthest point and of roughness 0, distinct from black."""


def depth_grays(depth_m: NDArray) -> NDArray[np.uint8]:
    """Return depths [R, R] in meters as grays: the nearest is white, the farthest dark.

    The grays fall in proportion to the depth. Infinite depths are black.
    """
    near, far = finite_range(depth_m) or (0.0, 0.0)
    span = far - near
    return fraction_grays(
        np.where(np.isfinite(depth_m), (far - depth_m) / span if span else 1, np.nan)
    )


def fraction_grays(share: NDArray) -> NDArray[np.uint8]:
    """Return numbers from 0 to 1 [R, R] as grays from dark to white; NaN is black."""
    is_hit = np.isfinite(share)
    greys = _DARKEST + (255 - _DARKEST) * np.clip(np.where(is_hit, share, 0), 0, 1)
    return np.where(is_hit, np.round(greys), 0).astype(np.uint8)


def normal_colors(normal: NDArray) -> NDArray[np.uint8]:
    """Return unit vectors [R, R, 3] as RGB: -1 to 1 become 0 to 255; NaN is black."""
    return np.round(np.where(np.isnan(normal), 0, (normal + 1) * 127.5)).astype(np.uint8)


def albedo_colors(albedo: NDArray) -> NDArray[np.uint8]:
    """Return linear colors [R, R, 3] from 0 to 1 as sRGB; NaN is black."""
    return srgb8(np.nan_to_num(albedo))


def id_colors(ids: ArrayLike) -> NDArray[np.uint8]:
    """Return the colors of ids [...], as [..., 3] RGB: the palette of PASCAL VOC's label pictures.

    An id has the same color in every scene, and no two ids below 2^24 - 1 share one: from its
    lowest bit on, the bits of id + 1 go to red, green and blue alternately, to the highest bits
    first. -1, no surface, is black.
    """
    code = np.asarray(ids, np.int64) - MISS
    colours = np.zeros((*code.shape, 3), np.uint8)
    for bit in range(24):
        colours[..., bit % 3] |= ((code >> bit & 1) << 7 - bit // 3).astype(np.uint8)
    return colours


def finite_range(values: NDArray) -> tuple[float, float] | None:
    """Return the least and the greatest finite number; None if there is none."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else None
