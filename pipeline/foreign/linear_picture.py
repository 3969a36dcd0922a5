"""Pictures of floats in the primaries of Rec.709, which are those of all stored light.

Bradford's matrix adapts the white point of a picture to that of Rec.709, so that gray stays gray.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.errors import Rejected

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""CIE x and y of red, green, blue and white of Rec.709."""

_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
SAME = 1e-3
"""Primaries that differ by less count as equal: files round them to three or four digits."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearPicture:
    """A picture of floats, of any format."""

    values: NDArray[np.float32]
    """[H, W, C], the top row first: gray, gray and alpha, RGB or RGBA. Alpha is not divided out."""
    unread: tuple[str, ...] = ()
    """Short sentences on contents of the file that are not read."""


def require_pixels(width: int, height: int, most: int) -> None:
    """Raise Rejected `too_many_pixels` for a picture of more pixels than `most`, or of none."""
    if not 0 < width * height <= most:
        raise Rejected(
            "too_many_pixels", f"{width} x {height}; expected at most {most} pixels: scale it down"
        )


def luminance_weights(primaries: Sequence[float]) -> NDArray[np.float64]:
    """Return the luminance [3] of red, green and blue, with sum 1; raises Rejected `load_error`."""
    weights: NDArray[np.float64] = _to_xyz(primaries)[1]
    return weights


def rec709_from(primaries: Sequence[float]) -> NDArray[np.float64]:
    """Return the matrix [3, 3] from colors of primaries [8] to those of Rec.709.

    Raises:
        Rejected: load_error: the primaries span no colors.
    """
    source = _to_xyz(primaries)
    target = _to_xyz(REC709)
    cones = [_BRADFORD @ matrix.sum(axis=1) for matrix in (source, target)]
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(cones[1] / cones[0]) @ _BRADFORD
    result: NDArray[np.float64] = np.linalg.inv(target) @ adapted @ source
    return result


def as_rec709(rgb: NDArray[np.float32], primaries: Sequence[float]) -> NDArray[np.float32]:
    """Return colors [H, W, 3] in Rec.709, negative channels of colors outside of its gamut as 0.

    Colors with a negative channel before the conversion keep theirs. Primaries that are those of
    Rec.709 within rounding change no color.

    Raises:
        Rejected: as `rec709_from`.
    """
    if np.allclose(primaries, REC709, rtol=0, atol=SAME):
        return rgb
    matrix = rec709_from(primaries).astype(np.float32)
    converted: NDArray[np.float32] = rgb @ matrix.T
    return np.where((rgb >= 0).all(axis=-1, keepdims=True), np.maximum(converted, 0), converted)


def clip_to_unit(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return values in [0, 1], and a note where some are beyond.

    Raises:
        Rejected: not_a_number.
    """
    if not np.isfinite(values).all():
        raise Rejected("not_a_number", "some of its values are no finite numbers; repair them")
    low = float(values.min(initial=0))
    high = float(values.max(initial=0))
    if low >= 0 and high <= 1:
        return values, ()
    return np.clip(values, 0, 1), (f"values beyond [0, 1] ({low:.3g} to {high:.3g})",)


def _to_xyz(primaries: Sequence[float]) -> NDArray[np.float64]:
    points = np.asarray(primaries, np.float64).reshape(4, 2)
    with np.errstate(all="ignore"):
        x, y = points.T
        xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
        if np.isfinite(xyz).all() and abs(np.linalg.det(xyz[:, :3])) > 1e-9:
            matrix: NDArray[np.float64] = xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
            if np.isfinite(matrix).all() and (_BRADFORD @ matrix.sum(axis=1) > 0).all():
                return matrix
    raise Rejected("load_error", f"its primaries are {points.tolist()}; expected four of a color")
