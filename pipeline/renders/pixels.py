"""`Pixels`: the operations on pictures that numpy and kernels write unlike; here in numpy.

All that must stay in numpy for published sets is here: sums in another order change last digits.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.samples import by_tiles
from pipeline.renders.view_pictures import GLINT, MOST_APART
from storage.conventions import log10_radiance


class Pixels:
    """Operations on pictures [R, R, 3], single or double, and on values of pixels [R, R]."""

    log10 = staticmethod(log10_radiance)
    clamp = staticmethod(clamped_radiance)
    sqrt: Any = np.sqrt
    maximum: Any = np.maximum

    def single(self, color: Any) -> Any:
        return color.astype(np.float32)

    def double(self, color: Any) -> Any:
        return color.astype(np.float64)

    def select(self, mask: Any, first: Any, second: Any) -> Any:
        return np.where(mask[..., None] if np.ndim(first) > mask.ndim else mask, first, second)

    def channels(self, color: Any) -> Sequence[Any]:
        return list(np.moveaxis(color, -1, 0))

    def channel_mean(self, color: Any) -> Any:
        return color.mean(axis=-1)

    def brightest(self, color: Any) -> Any:
        """Return the largest channel of each pixel."""
        return color.max(axis=-1)

    def is_finite(self, color: Any) -> Any:
        return np.isfinite(color).all(axis=-1)

    def mean(self, total: Any, count: Any) -> Any:
        """Return the color of pixels whose sum is `total`."""
        return total / count[..., None]

    def difference(self, first: Any, second: Any) -> Any:
        """Return the difference of single colors in double precision."""
        return (first - second).astype(np.float64)

    def are_equal(self, first: Any, second: Any) -> bool:
        """Return whether pictures are known to be equal."""
        return np.array_equal(first, second)

    def error_around(self, squared_error: Any) -> Any:
        """Return the root of the mean over 3 x 3 pixels."""
        edge = np.pad(np.sqrt(squared_error) ** 2, 1, "edge")
        return np.sqrt(sliding_window_view(edge, (3, 3)).mean((2, 3)))

    def clean(self, inputs: Any, outputs: Any, guides: Any, *, are_lights: bool) -> list[Any]:
        """Return what the filter made of inputs, without what it paints where no light is.

        Args:
            inputs: what `to_filter` yields.
            outputs: pictures by the filter.
            guides: albedo and normal by the name of a part.
            are_lights: whether lights alone are among them.
        """
        return list(outputs)

    def with_means(self, pairs: Sequence[tuple[Any, Any]]) -> list[Any]:
        """Return pictures (denoised, raw) with the mean of the raw ones (see view_pictures)."""
        return [with_mean_of(*pair) for pair in pairs]

    def shares(self, parts: Sequence[Any]) -> list[Any]:
        """Return what share of their sum each of some pictures is: equal ones where all are 0."""
        parts_rgb = np.stack(parts)
        total = parts_rgb.sum(axis=0, dtype=np.float64)
        equal = np.full(parts_rgb.shape, 1 / len(parts_rgb))
        return list(np.divide(parts_rgb, total, out=equal, where=total > 0).astype(np.float32))

    def tile_sums(self, values: Sequence[Any]) -> Sequence[Any]:
        """Return the sums over tiles of each of some values of pixels."""
        return [by_tiles(each).sum(axis=(1, 3)).ravel() for each in values]

    def totals_of_tiles(self, values: Sequence[Any]) -> Any:
        """Return the sum over all tiles of each of some values of tiles."""
        return np.array([each.sum() for each in values])


def with_mean_of(
    denoised_rgb: NDArray[np.float32], raw_rgb: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the denoised picture with the mean brightness of the raw one.

    Args:
        denoised_rgb: [..., 3] linear radiance.
        raw_rgb: the same view before the denoiser.
    """
    glints = denoised_rgb.mean(axis=-1) > GLINT
    factors = [_factor(denoised_rgb[part], raw_rgb[part]) for part in (glints, ~glints)]
    if min(factors) < 1 / MOST_APART or max(factors) > MOST_APART:
        factors = [_factor(denoised_rgb, raw_rgb)] * 2
    return (denoised_rgb * np.where(glints, *factors)[..., None]).astype(np.float32)


def _factor(denoised_rgb: NDArray[np.float32], raw_rgb: NDArray[np.float32]) -> float:
    is_now = denoised_rgb.sum(dtype=np.float64)
    return float(raw_rgb.sum(dtype=np.float64) / is_now) if is_now > 0 else 1.0
