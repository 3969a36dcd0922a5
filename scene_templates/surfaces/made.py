"""Surfaces of metal, thread and paint: rust, brushed metal, fabric, camouflage."""

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import Numbers, smoothstep
from scene_templates.surfaces.draws import RGB, GlossRanges, SurfaceDraws
from scene_templates.surfaces.maps import Finish
from scene_templates.surfaces.texels import TEXELS_PER_CELL, Texels

DARK_METAL = (0.5, 0.42, 0.3)
BRIGHT_METAL = (0.95, 0.92, 0.9)
"""From bronze to silver, roughly."""


def rust(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Rust in two tones over bare or painted steel."""
    share = draws.uniform("share of the rust", 0.1, 0.8)
    cells = draws.whole("cells of the rust a side", 2, 5)
    if draws.holds("painted", 0.5):
        under = draws.finish(
            "paint",
            low=(0.05, 0.05, 0.05),
            high=(0.8, 0.7, 0.6),
            specular=(0.04, 0.25),
            roughness=(0.1, 0.6),
        )
    else:
        under = draws.finish(
            "steel",
            low=DARK_METAL,
            high=BRIGHT_METAL,
            metal=True,
            specular=(0.7, 0.95),
            roughness=(0.1, 0.5),
        )
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
    metal = draws.finish(
        "metal",
        low=DARK_METAL,
        high=BRIGHT_METAL,
        metal=True,
        specular=(0.75, 0.95),
        roughness=(0.1, 0.5),
    )
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
    random = draws.stream()
    uneven = np.where(over, *_of_threads(random, threads, column, row))
    fluff = texels.noise(draws.stream(), (32, 32), octaves=2)
    woven = across.covered(along, over).toned(1 - wear * uneven)
    return woven.toned(shade * (0.9 + 0.15 * fluff))


def _of_threads(
    random: np.random.Generator, threads: int, column: NDArray, row: NDArray
) -> tuple[NDArray, NDArray]:
    """Return a number in [0, 1] for the thread of each column and for that of each row."""
    warp = random.random(threads)
    weft = random.random(threads)
    return warp[column.astype(np.int64) % threads], weft[row.astype(np.int64) % threads]


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
