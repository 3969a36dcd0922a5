"""Surfaces that are laid or printed in a pattern: checker, stripes, bricks, tiles, hexagons.

Each function takes the draws of one surface and its texels, and returns what it is made of.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import Numbers, ramp
from scene_templates.surfaces.draws import GlossRanges, SurfaceDraws
from scene_templates.surfaces.maps import Finish
from scene_templates.surfaces.texels import Texels


def checker(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Squares of two finishes in turn."""
    squares = 2 * draws.whole("pairs of squares a side", 1, 8)
    light = draws.finish(
        "light square",
        low=(0.6, 0.55, 0.45),
        high=(0.9, 0.88, 0.85),
        specular=(0.02, 0.4),
        roughness=(0.05, 0.9),
    )
    dark = draws.finish(
        "dark square",
        low=(0.02, 0.02, 0.02),
        high=(0.3, 0.2, 0.2),
        specular=(0.02, 0.4),
        roughness=(0.05, 0.9),
    )
    sign = _square_wave(texels.u, squares, texels) * _square_wave(texels.v, squares, texels)
    return light.covered(dark, (1 - sign) / 2)


def _square_wave(place: Numbers, squares: int, texels: Texels) -> Numbers:
    """Return 1 in even squares, -1 in odd ones, and the mean within the texels on an edge."""
    square_index = np.floor(place * squares)
    inside = place * squares - square_index
    edge_px = np.minimum(inside, 1 - inside) / squares * texels.size
    return (1 - 2 * (square_index % 2)) * (2 * ramp(edge_px) - 1)


def stripes(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Straight bands of one finish on another, along an axis or a diagonal."""
    bands = draws.whole("bands", 2, 14)
    along = draws.choice("run along", ("u", "v", "rising diagonal", "falling diagonal"))
    width = draws.uniform("share of the bands", 0.2, 0.8)
    ground = draws.finish(
        "ground",
        low=(0.1, 0.1, 0.1),
        high=(0.9, 0.85, 0.8),
        specular=(0.02, 0.3),
        roughness=(0.1, 1.0),
    )
    band = draws.finish(
        "band",
        low=(0.05, 0.05, 0.05),
        high=(0.8, 0.5, 0.7),
        specular=(0.02, 0.3),
        roughness=(0.1, 1.0),
    )
    slopes = {"u": (0, 1), "v": (1, 0), "rising diagonal": (1, -1), "falling diagonal": (1, 1)}
    in_u, in_v = slopes[along]
    phase = bands * (in_u * texels.u + in_v * texels.v)
    from_middle = np.abs(phase - np.floor(phase) - 0.5)
    steepness = bands * math.sqrt(in_u * in_u + in_v * in_v)
    return ground.covered(band, ramp((width / 2 - from_middle) / steepness * texels.size))


@dataclass(frozen=True, eq=False)
class Pieces:
    """Index of the brick, tile or board of each texel."""

    row: NDArray[np.int64]
    """[size, size] from the bottom."""
    column: NDArray[np.int64]
    """[size, size] within its row."""
    edge: Numbers
    """[size, size] distance to the nearest edge of the piece, in widths of the map."""

    def of_each(self, values: NDArray) -> NDArray:
        """Return the value [rows, columns] of each texel's piece."""
        return values[self.row, self.column]


def lay_rows(texels: Texels, rows: int, columns: int, shifts: NDArray) -> Pieces:
    """Return rows of equal pieces, each row shifted by a share [rows] of a piece to the left."""
    y = texels.v * rows
    below = np.floor(y)
    row = below.astype(np.int64) % rows
    x = texels.u * columns + shifts[row]
    column = np.floor(x)
    offset_u = x - column
    offset_v = y - below
    edge_u = np.minimum(offset_u, 1 - offset_u) / columns
    edge_v = np.minimum(offset_v, 1 - offset_v) / rows
    everywhere = np.zeros((texels.size, texels.size), np.int64)
    return Pieces(
        row=row + everywhere,
        column=column.astype(np.int64) % columns + everywhere,
        edge=np.minimum(edge_u, edge_v),
    )


def bricks(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Courses of bricks that differ in tone, with mortar between them."""
    rows = 2 * draws.whole("pairs of courses", 3, 8)
    columns = draws.whole("bricks a course", 2, 6)
    bond = draws.choice("bond", ("running", "stacked", "random"))
    joint = draws.uniform("joint, in heights of a course", 0.06, 0.2)
    spread = draws.uniform("darkening of the darkest brick", 0.1, 0.6)
    brick = draws.finish(
        "brick", low=(0.25, 0.06, 0.03), high=(0.75, 0.3, 0.2), roughness=(0.6, 1.0)
    )
    mortar = draws.finish(
        "mortar", low=(0.3, 0.28, 0.25), high=(0.7, 0.68, 0.62), roughness=(0.8, 1.0)
    )
    random = draws.stream()
    tones = random.random((rows, columns))
    loose = random.random(rows)
    running = 0.5 * (np.arange(rows) % 2)
    shifts = {"running": running, "stacked": np.zeros(rows), "random": loose}[bond]
    pieces = lay_rows(texels, rows, columns, shifts)
    clay = texels.noise(draws.stream(), (16, 16), octaves=3)
    worn = texels.noise(draws.stream(), (12, 12), octaves=3) * 0.05 / rows
    baked = brick.toned(1 - spread * pieces.of_each(tones)).toned(0.85 + 0.25 * clay)
    return mortar.toned(0.9 + 0.15 * clay).covered(
        baked, ramp((pieces.edge + worn - joint / 2 / rows) * texels.size)
    )


def tiles(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Glazed square tiles of one or two finishes, and grout."""
    side = 2 * draws.whole("pairs of tiles a side", 1, 5)
    pattern = draws.choice("pattern", ("plain", "scattered", "chequered"))
    joint = draws.uniform("joint, in widths of a tile", 0.02, 0.08)
    glaze = GlossRanges(specular=(0.04, 0.4), roughness=(0.05, 0.4))
    first = draws.finish("first tile", low=(0.5, 0.5, 0.45), high=(0.9, 0.9, 0.9), **glaze)
    second = draws.finish("second tile", low=(0.02, 0.05, 0.1), high=(0.5, 0.5, 0.6), **glaze)
    grout = draws.finish("grout", low=(0.15, 0.15, 0.14), high=(0.7, 0.7, 0.68), roughness=(0.8, 1))
    random = draws.stream()
    tones = random.random((side, side))
    picks = random.random((side, side)) < 0.3
    pieces = lay_rows(texels, side, side, np.zeros(side))
    chequered = (np.arange(side)[:, None] + np.arange(side)) % 2 == 1
    which = {"plain": np.zeros_like(picks), "scattered": picks, "chequered": chequered}[pattern]
    tile = first.covered(second, pieces.of_each(which)).toned(1 - 0.12 * pieces.of_each(tones))
    return grout.covered(tile, ramp((pieces.edge - joint / 2 / side) * texels.size))


HEXAGONS = {"5 by 6": (5, 6), "7 by 8": (7, 8), "12 by 14": (12, 14)}
"""Columns and rows of hexagons that repeat on a square and are regular within 4 %."""


def hexagons(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Hexagonal tiles of two finishes, and grout."""
    columns, rows = HEXAGONS[draws.choice("hexagons", tuple(HEXAGONS))]
    joint = draws.uniform("joint, in widths of a tile", 0.03, 0.12)
    share = draws.uniform("share of the second tile", 0.0, 0.5)
    glaze = GlossRanges(specular=(0.04, 0.4), roughness=(0.05, 0.6))
    first = draws.finish("first tile", low=(0.4, 0.35, 0.3), high=(0.9, 0.88, 0.85), **glaze)
    second = draws.finish("second tile", low=(0.02, 0.05, 0.05), high=(0.6, 0.4, 0.4), **glaze)
    grout = draws.finish("grout", low=(0.1, 0.1, 0.1), high=(0.6, 0.6, 0.58), roughness=(0.8, 1))
    random = draws.stream()
    tones = random.random((rows, columns))
    picks = random.random((rows, columns)) < share
    index, edge = _hexagon_of(texels, columns, rows)
    tile = first.covered(second, picks.ravel()[index]).toned(1 - 0.2 * tones.ravel()[index])
    return grout.covered(tile, ramp((edge - joint / 2) / columns * texels.size))


def _hexagon_of(texels: Texels, columns: int, rows: int) -> tuple[NDArray[np.int64], Numbers]:
    """Return the number of each texel's hexagon, and the distance to its edge in its widths.

    Middles lie on two lattices: even rows, and odd rows half a width to the side.
    """
    pitch = math.sqrt(0.75)
    best = np.full((texels.size, texels.size), np.inf)
    index = np.zeros(best.shape, np.int64)
    edge = best.copy()
    for row_parity in (0, 1):
        column = np.floor(texels.u * columns - row_parity / 2 + 0.5)
        row = 2 * np.floor((texels.v * rows - row_parity) / 2 + 0.5) + row_parity
        x = np.abs(texels.u * columns - row_parity / 2 - column)
        y = np.abs(texels.v * rows - row) * pitch
        distance_squared = x * x + y * y
        nearer = distance_squared < best
        number = (row % rows) * columns + column % columns
        best = np.where(nearer, distance_squared, best)
        index = np.where(nearer, number.astype(np.int64), index)
        edge = np.where(nearer, 0.5 - np.maximum(x, x / 2 + y * pitch), edge)
    return index, edge
