"""Checks a user's environment map (HDRI), repairs small negative values, and resamples it.

Radiance is linear. A NaN or infinite value rejects the map: half floats end at 65,504, so that a
brighter sun was written as infinite and is lost. Small negative values, which color conversions
leave, become 0 where together they are at most a thousandth of the light.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.maps.resample import flux, solid_angle_means
from storage.errors import Rejected
from storage.records.environment import MAX_RADIANCE

MOST_NEGATIVE = 1e-3
"""Largest fraction of a map's light that its negative values may take away."""


def usable_map(radiance: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """Return a map of at most `height` rows, by means over solid angle.

    Args:
        radiance: [H, W, 3] linear, the top row first.
        height: most rows of the result; a smaller map stays unchanged.

    Raises:
        Rejected: not_two_to_one, not_a_number, infinite_radiance, negative_radiance,
            too_bright, black_map.
    """
    rows, columns = radiance.shape[:2]
    if columns != 2 * rows:
        raise Rejected(
            "not_two_to_one",
            f"the picture is {columns} x {rows}; expected latitude-longitude, twice as wide as "
            "high: convert cube maps and fisheyes, crop or scale others",
        )
    _refuse(np.isnan(radiance), "not_a_number", "is not a number; mend it in a picture editor")
    _refuse(
        np.isinf(radiance),
        "infinite_radiance",
        "is infinite; write the map in 32 bits, or as .hdr: half floats end at 65504",
    )
    lawful = np.maximum(radiance, 0)
    total = flux(lawful)
    negative = flux(lawful - radiance)
    if (negative > MOST_NEGATIVE * total).any() and negative.any():
        raise Rejected(
            "negative_radiance",
            f"negative values take more than {MOST_NEGATIVE:g} of the light of a channel; set them "
            "to 0 in a picture editor",
        )
    _refuse(lawful > MAX_RADIANCE, "too_bright", f"is over {MAX_RADIANCE:g}; scale the map down")
    if not total.sum() > 0:
        raise Rejected("black_map", "the map is black; expected some light")
    return lawful if rows <= height else solid_angle_means(lawful, height).astype(np.float32)


def _refuse(wrong: NDArray[np.bool_], reason: str, message: str) -> None:
    if wrong.any():
        row, column, channel = (int(i) for i in np.argwhere(wrong)[0])
        where = f"{'RGB'[channel]} of row {row}, column {column} (from the top left)"
        raise Rejected(reason, f"{where} {message}")
