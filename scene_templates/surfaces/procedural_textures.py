"""Procedural textures of surfaces, by name of their family; extensions may add to them.

A family is a function of the draws of one surface and its texels; it returns what the surface is
made of. All that it draws has a name and a stated range, and noises and patterns take a stream of
their own, so that the same seed gives the same surface at every size. Some are laid or printed in a
pattern, some grew or were cut from stone, and some are of metal, thread and paint.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range, require
from scene_templates.exact import TEXELS_PER_CELL, Numbers, ramp, smoothstep
from scene_templates.layout import RGB
from scene_templates.surfaces.maps import (
    MOST_ALBEDO,
    Finish,
    GlossRanges,
    SurfaceDraws,
    SurfaceMaps,
    Texels,
    stones,
)
from storage.records.texture import MapSource
from storage.registry import Registry
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


def checker(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Squares of two finishes in turn."""
    squares = 2 * draws.whole("pairs of squares a side", 1, 8)
    gloss = GlossRanges(specular=(0.02, 0.4), roughness=(0.05, 0.9))
    light = draws.finish("light square", low=(0.6, 0.55, 0.45), high=(0.9, 0.88, 0.85), **gloss)
    dark = draws.finish("dark square", low=(0.02, 0.02, 0.02), high=(0.3, 0.2, 0.2), **gloss)
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
    gloss = GlossRanges(specular=(0.02, 0.3), roughness=(0.1, 1.0))
    ground = draws.finish("ground", low=(0.1, 0.1, 0.1), high=(0.9, 0.85, 0.8), **gloss)
    band = draws.finish("band", low=(0.05, 0.05, 0.05), high=(0.8, 0.5, 0.7), **gloss)
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


LATE_WOOD = 0.8
"""Where in a ring the slow darkening ends and the next ring begins."""


def planks(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Boards with grain along u, each cut from another place, with gaps between them."""
    rows = draws.whole("rows of boards", 3, 8)
    columns = draws.whole("boards a row", 1, 3)
    gap = draws.uniform("gap, in widths of a board", 0.02, 0.06)
    spread = draws.uniform("darkening of the darkest board", 0.1, 0.5)
    light, dark = _woods(draws)
    random = draws.stream()
    pieces = lay_rows(texels, rows, columns, random.random(rows))
    tones = pieces.of_each(random.random((rows, columns)))
    moved = tuple(pieces.of_each(random.random((rows, columns))) for _ in "uv")
    board = light.covered(dark, _grain(draws, texels, (moved[0], moved[1])))
    dark_gap = dark.toned(0.15).rougher(0.3)
    return dark_gap.covered(
        board.toned(1 - spread * tones), ramp((pieces.edge - gap / 2 / rows) * texels.size)
    )


def wood(draws: SurfaceDraws, texels: Texels) -> Finish:
    """One veneer with rings that run along u."""
    light, dark = _woods(draws)
    return light.covered(dark, _grain(draws, texels, None))


def _woods(draws: SurfaceDraws) -> tuple[Finish, Finish]:
    varnish = GlossRanges(specular=(0.02, 0.25), roughness=(0.15, 0.8))
    light = draws.finish("early wood", low=(0.35, 0.17, 0.07), high=(0.8, 0.55, 0.35), **varnish)
    dark = draws.finish("late wood", low=(0.08, 0.03, 0.01), high=(0.35, 0.18, 0.1), **varnish)
    return light, dark


def _grain(draws: SurfaceDraws, texels: Texels, moved: tuple[NDArray, NDArray] | None) -> Numbers:
    """Return how much of each texel is late wood: bent rings, and fibres along u."""
    rings = draws.whole("rings", 4, 12)
    bend = draws.uniform("bend of the rings, in rings", 0.3, 2.0)
    bent = texels.noise(draws.stream(), (1, 3), octaves=3, moved=moved)
    fibres = texels.noise(draws.stream(), (2, 32), octaves=2, moved=moved)
    phase = rings * (texels.v + (0.0 if moved is None else moved[1])) + bend * bent
    place = phase - np.floor(phase)
    ring = np.where(
        place < LATE_WOOD,
        smoothstep(place / LATE_WOOD),
        1 - smoothstep((place - LATE_WOOD) / (1 - LATE_WOOD)),
    )
    return np.clip(0.1 + 0.6 * ring + 0.3 * fibres, 0, 1)


def marble(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Polished stone with bent veins, broad ones and fine ones, and clouds between them."""
    cells = draws.whole("cells of the veins a side", 2, 4)
    width = draws.uniform("width of the veins", 0.05, 0.25)
    bend = draws.uniform("bend of the veins, in widths of the map", 0.03, 0.12)
    polish = GlossRanges(specular=(0.04, 0.35), roughness=(0.03, 0.35))
    stone = draws.finish("stone", low=(0.3, 0.3, 0.28), high=(0.9, 0.9, 0.88), **polish)
    vein = draws.finish("vein", low=(0.03, 0.03, 0.03), high=(0.5, 0.4, 0.3), **polish)
    moved = tuple(bend * texels.noise(draws.stream(), (cells, cells), octaves=4) for _ in "uv")
    bent = (moved[0], moved[1])
    broad = texels.noise(draws.stream(), (cells, cells), octaves=2, moved=bent)
    fine = texels.noise(draws.stream(), (2 * cells, 2 * cells), octaves=2, moved=bent)
    clouds = texels.noise(draws.stream(), (2, 2), octaves=5, moved=bent)
    veins = smoothstep(1 - np.abs(broad) / width)
    thin = 0.5 * smoothstep(1 - np.abs(fine) / (0.4 * width))
    share = 1 - (1 - veins) * (1 - thin) * (1 - 0.25 * smoothstep(0.5 + clouds))
    return stone.covered(vein, share)


def terrazzo(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Chips of three stones in polished cement."""
    cells = draws.whole("chips a side", 6, 20)
    gap = draws.uniform("cement between chips, in spacings", 0.1, 0.45)
    polish = GlossRanges(specular=(0.04, 0.25), roughness=(0.05, 0.4))
    cement = draws.finish("cement", low=(0.45, 0.43, 0.4), high=(0.9, 0.88, 0.85), **polish)
    chips = [
        draws.finish(f"{name} chip", low=(0.05, 0.04, 0.04), high=(0.85, 0.7, 0.6), **polish)
        for name in ("first", "second", "third")
    ]
    stone_cells = stones(texels, draws.stream(), cells)
    random = draws.stream()
    kind = random.integers(len(chips), size=cells * cells)[stone_cells.index]
    size = 0.6 + 0.8 * random.random(cells * cells)[stone_cells.index]
    made = cement.toned(0.92 + 0.1 * texels.noise(draws.stream(), (16, 16), octaves=3))
    for number, chip in enumerate(chips):
        inside = ramp((stone_cells.gap - gap * size) / 2 / cells * texels.size)
        made = made.covered(chip, inside * (kind == number))
    return made


def cobbles(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Rounded stones of many tones in earth or sand."""
    cells = draws.whole("stones a side", 4, 10)
    gap = draws.uniform("earth between stones, in spacings", 0.05, 0.2)
    jitter = draws.uniform("disorder", 0.5, 1.0)
    worn = GlossRanges(specular=(0.02, 0.15), roughness=(0.4, 0.9))
    stone = draws.finish("stone", low=(0.2, 0.19, 0.18), high=(0.7, 0.65, 0.6), **worn)
    earth = draws.finish(
        "earth", low=(0.08, 0.06, 0.04), high=(0.5, 0.42, 0.3), roughness=(0.85, 1.0)
    )
    bent = texels.noise(draws.stream(), (8, 8), octaves=3) * 0.02
    stone_cells = stones(texels, draws.stream(), cells, jitter=jitter, moved=(bent, -bent))
    tones = draws.stream().random(cells * cells)[stone_cells.index]
    grit = texels.noise(draws.stream(), (24, 24), octaves=2)
    round_off = 0.35 + 0.65 * smoothstep((stone_cells.gap - gap) / 0.35)
    top = stone.toned(1 - 0.5 * tones).toned(round_off).toned(0.9 + 0.2 * grit)
    inside = ramp((stone_cells.gap - gap) / 2 / cells * texels.size)
    return earth.toned(0.8 + 0.4 * grit).covered(top, inside)


def concrete(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Plaster or concrete: broad stains, fine grain and a few pits."""
    stains = draws.uniform("strength of the stains", 0.1, 0.6)
    grain = draws.uniform("strength of the grain", 0.05, 0.3)
    pits = draws.uniform("radius of the largest pits, in spacings", 0.0, 0.25)
    cells = draws.whole("pits a side", 8, 20)
    dull = GlossRanges(specular=(0.02, 0.08), roughness=(0.6, 1.0))
    body = draws.finish("body", low=(0.25, 0.25, 0.24), high=(0.85, 0.82, 0.76), **dull)
    broad = smoothstep(0.5 + 0.8 * texels.noise(draws.stream(), (2, 2), octaves=5))
    fine = texels.noise(draws.stream(), (32, 32), octaves=2)
    pit_cells = stones(texels, draws.stream(), cells)
    radius = pits * draws.stream().random(cells * cells)[pit_cells.index]
    pitted = ramp((radius - pit_cells.nearest) / cells * texels.size)
    toned = body.toned(1 - stains * broad).toned(1 - grain * (0.5 + 0.8 * fine))
    return toned.rougher(0.1 * (broad - 0.5)).covered(body.toned(0.2), pitted)


DARK_METAL = (0.5, 0.42, 0.3)
BRIGHT_METAL = (0.95, 0.92, 0.9)
"""From bronze to silver, roughly."""


def rust(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Rust in two tones over bare or painted steel."""
    share = draws.uniform("share of the rust", 0.1, 0.8)
    cells = draws.whole("cells of the rust a side", 2, 5)
    if draws.holds("painted", 0.5):
        gloss = GlossRanges(specular=(0.04, 0.25), roughness=(0.1, 0.6))
        under = draws.finish("paint", low=(0.05, 0.05, 0.05), high=(0.8, 0.7, 0.6), **gloss)
    else:
        gloss = GlossRanges(specular=(0.7, 0.95), roughness=(0.1, 0.5))
        under = draws.finish("steel", low=DARK_METAL, high=BRIGHT_METAL, metal=True, **gloss)
    fresh = draws.finish(
        "fresh rust", low=(0.35, 0.1, 0.02), high=(0.6, 0.25, 0.08), roughness=(0.7, 1.0)
    )
    old = draws.finish(
        "old rust", low=(0.08, 0.02, 0.01), high=(0.25, 0.08, 0.04), roughness=(0.8, 1.0)
    )
    eaten = texels.noise(draws.stream(), (cells, cells), octaves=6)
    tone = texels.noise(draws.stream(), (2 * cells, 2 * cells), octaves=5)
    scratched = texels.noise(draws.stream(), (4, 4), octaves=4)
    covered = smoothstep(0.5 + (eaten - exceeded_by(eaten, share)) / 0.12)
    return under.rougher(0.15 * smoothstep(0.5 + scratched)).covered(
        fresh.covered(old, smoothstep(0.5 + 0.9 * tone)), covered
    )


def exceeded_by(noise: Numbers, share: float) -> float:
    """Return the level that `share` of the texels exceed."""
    ordered = np.sort(noise, axis=None)
    return float(ordered[min(int((1 - share) * ordered.size), ordered.size - 1)])


def brushed_metal(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Metal with fine scratches along one axis, and smudges."""
    along = draws.choice("brushed along", ("u", "v"))
    depth = draws.uniform("darkening of the scratches", 0.05, 0.4)
    uneven = draws.uniform("roughness that the smudges add", 0.0, 0.25)
    gloss = GlossRanges(specular=(0.75, 0.95), roughness=(0.1, 0.5))
    metal = draws.finish("metal", low=DARK_METAL, high=BRIGHT_METAL, metal=True, **gloss)
    coarse, fine = ((1, 16), (2, 64)) if along == "u" else ((16, 1), (64, 2))
    lines = texels.noise(draws.stream(), coarse, octaves=2) + texels.noise(draws.stream(), fine)
    smudges = texels.noise(draws.stream(), (3, 3), octaves=4)
    scratched = metal.dimmed(1 - depth * smoothstep(0.5 + lines))
    return scratched.rougher(0.1 * depth * lines + uneven * smoothstep(0.5 + smudges))


def fabric(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Woven cloth: threads of two colours over and under each other, plain or twilled."""
    threads = 4 * draws.whole("threads a side, in fours", 3, 8)
    weave = draws.choice("weave", ("plain", "twill"))
    wear = draws.uniform("unevenness of the threads", 0.0, 0.5)
    cloth = GlossRanges(specular=(0.0, 0.06), roughness=(0.6, 1.0))
    along = draws.finish("warp", low=(0.05, 0.05, 0.06), high=(0.85, 0.75, 0.65), **cloth)
    across = draws.finish("weft", low=(0.05, 0.05, 0.06), high=(0.85, 0.8, 0.75), **cloth)
    column = np.floor(texels.u * threads)
    row = np.floor(texels.v * threads)
    over = (column + row) % 2 < 1 if weave == "plain" else (column + row) % 4 < 2
    in_u = 2 * (texels.u * threads - column) - 1 + np.zeros((texels.size, 1))
    in_v = 2 * (texels.v * threads - row) - 1 + np.zeros((1, texels.size))
    rim = np.where(over, in_u, in_v)
    crown = np.where(over, in_v, in_u)
    visible_fraction = min(1.0, texels.size / (TEXELS_PER_CELL * threads))
    # 0.3 is the mean of what is taken off: where threads are too fine to show, it alone is left
    shade = 0.7 - visible_fraction * (0.7 * rim * rim + 0.2 * crown * crown - 0.3)
    warp, weft = draws.stream().random((2, threads))
    of_warp = warp[column.astype(np.int64) % threads]
    uneven = np.where(over, of_warp, weft[row.astype(np.int64) % threads])
    fluff = texels.noise(draws.stream(), (32, 32), octaves=2)
    woven = across.covered(along, over).toned(1 - wear * uneven)
    return woven.toned(shade * (0.9 + 0.15 * fluff))


def camouflage(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Blotches of three paints on a fourth."""
    cells = draws.whole("blotches a side", 2, 6)
    paint = GlossRanges(specular=(0.0, 0.15), roughness=(0.4, 1.0))
    ranges: dict[str, tuple[RGB, RGB]] = {
        "ground": ((0.25, 0.22, 0.12), (0.6, 0.55, 0.4)),
        "first blotch": ((0.05, 0.1, 0.03), (0.2, 0.3, 0.12)),
        "second blotch": ((0.1, 0.05, 0.02), (0.3, 0.18, 0.1)),
        "third blotch": ((0.01, 0.01, 0.01), (0.08, 0.08, 0.08)),
    }
    ground, *blotches = (
        draws.finish(name, low=low, high=high, **paint) for name, (low, high) in ranges.items()
    )
    made = ground
    for name, blotch in zip(list(ranges)[1:], blotches, strict=True):
        share = draws.uniform(f"share of the {name}", 0.15, 0.45)
        field = texels.noise(draws.stream(), (cells, cells), octaves=3)
        soft = 0.5 + (field - exceeded_by(field, share)) * texels.size / (4 * cells)
        made = made.covered(blotch, np.clip(soft, 0, 1))
    return made.toned(0.95 + 0.1 * texels.noise(draws.stream(), (32, 32), octaves=2))


SurfaceFamily = Callable[[SurfaceDraws, Texels], Finish]

_OURS: tuple[SurfaceFamily, ...] = (
    checker, stripes, bricks, tiles, hexagons, planks, wood, marble, terrazzo, cobbles,
    concrete, rust, brushed_metal, fabric, camouflage,
)  # fmt: skip

SURFACES: Registry[SurfaceFamily] = Registry(
    "surface", Callable, {make.__name__: make for make in _OURS}, decides=("data",)
)
"""Every name that `SurfaceMapSettings.families` admits."""

OUR_SURFACES = tuple(SURFACES)
"""What surfaces are drawn from unless the settings say otherwise; registering another does not
change it."""


@checked("surface settings")
class SurfaceMapSettings:
    """What procedural surfaces are drawn from."""

    families: tuple[str, ...] = OUR_SURFACES
    """Families of surfaces, each equally likely; a name that stands twice is twice as likely."""
    size: Annotated[int, Within(1, 2048, unit="texels")] = 256
    """Width and height of a map, a power of two. The same seed gives the same surface at every
    size; below 64 the finest pattern is a blur."""
    natural_share: Share = 0.7
    """Share of the surfaces with the colors of their family; in the others, each channel of each
    base color is uniform in `albedo`."""
    albedo: Annotated[Range, Within(0, MOST_ALBEDO)] = (0.02, 0.9)
    """Range of each channel of a base color that is not natural."""
    roughness_clip: Annotated[Range, Within(0, 1)] = (0.01, 1.0)
    """Minimum and maximum roughness, as of constant materials."""

    def __post_init__(self) -> None:
        require(len(self.families) > 0, "families", self.families, "at least one")
        for name in self.families:
            SURFACES.find(name)
        require(self.size & (self.size - 1) == 0, "size", self.size, "a power of two")


def draw_surface(rng: np.random.Generator, settings: SurfaceMapSettings) -> SurfaceMaps:
    """Draw a surface of one of the families.

    Equal generators and settings give equal bytes on every processor with IEEE arithmetic: maps are
    made of + - * /, square roots and comparisons of float64, and rounded to float32 once.

    A map of 256 x 256 texels takes 0.005 to 0.15 core-seconds.

    Args:
        rng: such as `rng_for(seed, "surface", number)`. What is drawn of it does not depend on the
            size.
        settings: the ranges.

    Returns:
        float32 maps [N, N, 3], [N, N, 3] and [N, N, 1] that repeat in both directions.
    """
    name = settings.families[int(rng.integers(len(settings.families)))]
    draws = SurfaceDraws(rng, natural_share=settings.natural_share, albedo=settings.albedo)
    made_of = SURFACES[name](draws, Texels(settings.size))
    full_size = np.zeros((settings.size, settings.size, 1))
    roughness = np.clip(made_of.roughness[..., None] + full_size, *settings.roughness_clip)
    return SurfaceMaps(
        diffuse_rgb=(made_of.diffuse_rgb + full_size).astype(np.float32),
        specular_rgb=(made_of.specular_rgb + full_size).astype(np.float32),
        roughness=roughness.astype(np.float32),
        source=MapSource(name=name),
    )
