"""Area means: resampling to fewer texels that preserves the total light.

A source is constant within each texel. A texel of the result is the mean over the area that it
covers, by the exact overlaps; on the sphere, area is solid angle. So the integral stays, and no sun
is lost or doubled, whatever the two sizes are.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array


def area_means(values: NDArray, height: int, width: int) -> NDArray[np.float64]:
    """Return a flat picture [H, W, C] as [height, width, C] means."""
    return _means(values, _overlaps(_even(len(values)), _even(height)), width)


def solid_angle_means(radiance: NDArray, height: int) -> NDArray[np.float64]:
    """Return a latitude-longitude map [H, 2H, C] as [height, 2 height, C] means by solid angle."""
    rows = _overlaps(_latitudes(len(radiance)), _latitudes(height))
    return _means(radiance, rows, 2 * height)


def flux(radiance: NDArray) -> NDArray[np.float64]:
    """Return the integral [C] over the sphere of a latitude-longitude map [H, W, C]."""
    rows = np.diff(_latitudes(len(radiance))) * 2 * np.pi
    return rows @ radiance.mean(axis=1, dtype=np.float64)


def _means(values: NDArray, rows: csr_array, width: int) -> NDArray[np.float64]:
    height = rows.shape[0]
    channels = values.shape[2]
    columns = _overlaps(_even(values.shape[1]), _even(width))
    result = np.zeros((height, width, channels))
    for channel in range(channels):  # one at a time: the largest maps take a gigabyte
        result[..., channel] = (columns @ (rows @ values[..., channel].astype(np.float64)).T).T
    return result


def _even(count: int) -> NDArray[np.float64]:
    return np.arange(count + 1) / count


def _latitudes(count: int) -> NDArray[np.float64]:
    """Return the borders of a map's rows as heights 1 - cos on the sphere."""
    return 1 - np.cos(np.pi * np.arange(count + 1) / count)


def _overlaps(source: NDArray[np.float64], target: NDArray[np.float64]) -> csr_array:
    """Return the fraction [target, source] of each target interval that each source covers."""
    ends = np.union1d(source, target)
    ends = ends[np.concatenate([[True], np.diff(ends) > 1e-12])]  # rounding makes two of one
    middle = (ends[:-1] + ends[1:]) / 2
    into = np.clip(np.searchsorted(target, middle) - 1, 0, len(target) - 2)
    out_of = np.clip(np.searchsorted(source, middle) - 1, 0, len(source) - 2)
    fraction = np.diff(ends) / np.diff(target)[into]
    return csr_array((fraction, (into, out_of)), shape=(len(target) - 1, len(source) - 1))
