"""A surface of your own: polka dots, in two paints.

    trilight generate tiny --extend surface.py --settings dots.yaml --out data/polka

with dots.yaml, or `--set` with each of its lines:

    scenes.textures.share: 0.8
    scenes.textures.surfaces.families: [polka_dots]

A family is a function of draws and texels that returns what the surface is made of. Each draw has a
name and a range, so that `trilight` can say what was drawn; all that repeats does so with u and v.
"""

import numpy as np

from trilight.extend import SURFACES, Finish, SurfaceDraws, Texels


def polka_dots(draws: SurfaceDraws, texels: Texels) -> Finish:
    """Round dots of one paint on another, in rows."""
    dots = draws.whole("dots a side", 2, 12)
    radius = draws.uniform("radius of a dot, in spacings", 0.15, 0.4)
    ground = draws.finish("ground", low=(0.4, 0.4, 0.4), high=(0.9, 0.9, 0.9), roughness=(0.4, 1.0))
    dot = draws.finish("dot", low=(0.05, 0.02, 0.02), high=(0.6, 0.3, 0.3), roughness=(0.1, 0.6))
    x, y = (place * dots - np.floor(place * dots) - 0.5 for place in (texels.u, texels.v))
    # 1 inside, 0 outside, and between them over one texel, or small maps would have jagged dots
    edge = (radius - np.sqrt(x * x + y * y)) * texels.size / dots + 0.5
    return ground.covered(dot, np.clip(edge, 0, 1))


SURFACES.register("polka_dots", polka_dots)
