"""Surfaces that grew or were cut from stone: planks, wood, marble, terrazzo, cobbles, concrete."""

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import Numbers, ramp, smoothstep
from scene_templates.surfaces.draws import GlossRanges, SurfaceDraws
from scene_templates.surfaces.laid import lay_rows
from scene_templates.surfaces.maps import Finish
from scene_templates.surfaces.texels import Texels, stones

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
    stone = draws.finish(
        "stone",
        low=(0.2, 0.19, 0.18),
        high=(0.7, 0.65, 0.6),
        specular=(0.02, 0.15),
        roughness=(0.4, 0.9),
    )
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
    body = draws.finish(
        "body",
        low=(0.25, 0.25, 0.24),
        high=(0.85, 0.82, 0.76),
        specular=(0.02, 0.08),
        roughness=(0.6, 1.0),
    )
    broad = smoothstep(0.5 + 0.8 * texels.noise(draws.stream(), (2, 2), octaves=5))
    fine = texels.noise(draws.stream(), (32, 32), octaves=2)
    pit_cells = stones(texels, draws.stream(), cells)
    radius = pits * draws.stream().random(cells * cells)[pit_cells.index]
    pitted = ramp((radius - pit_cells.nearest) / cells * texels.size)
    toned = body.toned(1 - stains * broad).toned(1 - grain * (0.5 + 0.8 * fine))
    return toned.rougher(0.1 * (broad - 0.5)).covered(body.toned(0.2), pitted)
