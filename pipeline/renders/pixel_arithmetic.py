"""The formulas of a look as kernels: arithmetic of pixels, and sums over tiles and over all.

They are those of pipeline.renders.noise_floor and pipeline.renders.view_pictures. Sums are
taken over tiles of 64 pixels, then over rows of tiles: in their own order, but always the same one.
Pictures are Color3f, what is worked out of them is Float64, pixel by pixel.
"""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders.noise_floor import Halves, PixelArithmetic, pixel_errors, pixel_measures
from pipeline.renders.samples import TILE_PX
from pipeline.renders.view_pictures import GLINT, MOST_APART, add_up, stands_out

TILE = TILE_PX * TILE_PX
"""Pixels of a tile."""

_INV_LN_10 = 0.4342944819032518


def clean(picture: Any, raw: Any, normal: Any) -> Any:
    """Return a picture that is at least 0, and black where no ray hit anything."""
    covered = dr.any(dr.unravel(mi.Color3f, normal) != 0) | dr.any(raw != 0)
    return dr.select(covered, dr.maximum(picture, 0), 0)


def with_means_of(pairs: Sequence[tuple[Any, Any]], resolution: int) -> list[Any]:
    """Return pictures (denoised, raw) with the mean of the raw ones (see view_pictures)."""
    bright = [channel_mean(denoised) > GLINT for denoised, _ in pairs]
    values = [
        dr.select(part, channel_sum(mi.Color3d(picture)), 0)
        for glints, pair in zip(bright, pairs, strict=True)
        for part in (glints, ~glints)
        for picture in pair
    ]
    sums = totals(values, resolution)
    pictures = []
    for row, (glints, (denoised, _)) in enumerate(zip(bright, pairs, strict=True)):
        is_now, was, rest_is, rest_was = (
            dr.gather(mi.Float64, sums, 4 * row + each) for each in range(4)
        )
        factors = [_factor(is_now, was), _factor(rest_is, rest_was)]
        least = dr.minimum(*factors)
        most = dr.maximum(*factors)
        is_extreme = (least < 1 / MOST_APART) | (most > MOST_APART)
        common_factor = _factor(is_now + rest_is, was + rest_was)
        factor = dr.select(is_extreme, common_factor, dr.select(glints, *factors))
        pictures.append(mi.Color3f(mi.Color3d(denoised) * factor))
    return pictures


def _factor(is_now: Any, was: Any) -> Any:
    return dr.select(is_now > 0, was / is_now, 1)


def shares_of(parts: Sequence[Any]) -> list[Any]:
    """Return what share of their sum each of some pictures is: equal ones where all are 0."""
    total = add_up([mi.Color3d(part) for part in parts])
    return [
        mi.Color3f(dr.select(total > 0, mi.Color3d(part) / total, 1 / len(parts))) for part in parts
    ]


def converged_mask(denoised: list[Any], raw: list[Any], squared_error: Any, resolution: int) -> Any:
    """Return which pixels of the raw picture are right (Bool), as `converged_mask` in numpy."""
    is_now, was = (channel_mean(mi.Color3d(add_up(parts))) for parts in (denoised, raw))
    dr.eval(squared_error)  # eight neighbours of each pixel read it
    row, column = _rows_and_columns(resolution)
    around = mi.Float64(0)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            y = mi.UInt32(dr.clip(mi.Int32(row) + down, 0, resolution - 1))
            x = mi.UInt32(dr.clip(mi.Int32(column) + right, 0, resolution - 1))
            around += dr.gather(mi.Float64, squared_error, y * resolution + x)
    return stands_out(is_now, was, dr.sqrt(squared_error), dr.sqrt(around / 9))


def choose(right: Any, raw: list[Any], denoised: list[Any]) -> list[Any]:
    return [dr.select(right, *pair) for pair in zip(raw, denoised, strict=True)]


def estimates(halves: Halves, hit: Any, is_filtered: bool) -> tuple[list[Any], list[Any]]:
    """Return the squared errors and the surprises of pixels (Float64): log, linear, of objects."""
    rows = [
        pixel_errors(halves, curve, KERNELS, is_filtered=is_filtered)
        for curve in (KERNELS.log10, KERNELS.clamp)
    ]
    rows.append((dr.select(hit, rows[0][0], 0), dr.select(hit, rows[0][1], 0)))
    return [error for error, _ in rows], [surprise for _, surprise in rows]


def error_measures(
    halves: Halves, picture: Any, hit: Any, resolution: int
) -> tuple[Any, list[Any]]:
    """Return the totals of `measures_of_totals`, of one metric after another, and surprises.

    The picture (Color3d) is one denoise of all samples.
    """
    metrics = []
    surprises = []
    for curve in (KERNELS.log10, KERNELS.clamp):
        values, signed, surprise = pixel_measures(halves, picture, curve, KERNELS)
        metrics.append([*values, *(channel for color in signed for channel in color)])
        surprises.append(surprise)
    metrics.append([dr.select(hit, each, 0) for each in metrics[0]])
    flat = [each for values in metrics for each in values]
    tiles = reduce_tiles(flat, dr.ReduceOp.Add, resolution)
    across = resolution // TILE_PX
    tile = dr.arange(mi.UInt32, across**2)
    totals: list[Any] = []
    for first in range(0, len(flat), len(metrics[0])):
        rows = [dr.gather(mi.Float64, tiles, tile + (first + row) * across**2) for row in range(13)]
        sure = add_up(
            [
                x * x + z * h - z * z
                for x, z, h in zip(rows[4:7], rows[7:10], rows[10:], strict=True)
            ]
        )
        totals += [*rows[:4], sure / 3, add_up([dr.square(each) for each in rows[10:]]) / 12]
    rows_of_tiles = dr.block_sum(dr.block_sum(dr.concat(totals), across), across)
    return rows_of_tiles, [*surprises, dr.select(hit, surprises[0], 0)]


def log10(radiance: Any) -> Any:
    return dr.log(1 + radiance) * _INV_LN_10


def channel_sum(color: Any) -> Any:
    return color.x + color.y + color.z


def channel_mean(color: Any) -> Any:
    return channel_sum(color) / 3


KERNELS = PixelArithmetic(
    select=dr.select, channel_mean=channel_mean, log10=log10, clamp=lambda v: dr.clip(v, 0, 1)
)


def where_any(mask: Any, values: Any) -> Any:
    return dr.select(dr.any(mask != 0), values, 0)


def _rows_and_columns(resolution: int) -> tuple[Any, Any]:
    pixel = dr.arange(mi.UInt32, resolution**2)
    return pixel // resolution, pixel % resolution


def reduce_tiles(values: Sequence[Any], reduction: Any, resolution: int) -> Any:
    """Return values of pixels (Float64) reduced over tiles, those of one value after another's."""
    row, column = _rows_and_columns(resolution)
    tile = row // TILE_PX * (resolution // TILE_PX) + column // TILE_PX
    place = tile * TILE + row % TILE_PX * TILE_PX + column % TILE_PX
    packed = dr.zeros(mi.Float64, len(values) * resolution**2)
    for number, value in enumerate(values):
        dr.scatter(packed, mi.Float64(value), place + number * resolution**2)
    return dr.block_reduce(reduction, packed, TILE)


def totals(values: Sequence[Any], resolution: int) -> Any:
    """Return the sum over all pixels of each of some values (Float64)."""
    sums = reduce_tiles(values, dr.ReduceOp.Add, resolution)
    across = resolution // TILE_PX
    return dr.block_sum(dr.block_sum(sums, across), across)
