"""A sky of your own: a ring of light around the horizon, as in a lamp-lit stadium.

    trilight generate tiny --extend sky.py --settings ring.yaml --out data/ring

with ring.yaml, or `--set` with each of its lines:

    scenes.skies.share: 1
    scenes.skies.maps.families: [ring]

A family is a function of draws and texels that returns radiance of any strength [H, 2H, 3]: it is
scaled to what `scenes.skies` says. +Z is up, and the top row comes first.
"""

import numpy as np

from trilight.extend import SKIES, SkyDraws, SkyTexels


def ring(draws: SkyDraws, texels: SkyTexels) -> np.ndarray:
    """A soft ring of light at one height, and a dim rest."""
    height = draws.uniform("height of the ring, as the sine of its elevation", 0.0, 0.6)
    width = draws.uniform("half width of the ring, likewise", 0.02, 0.2)
    rest = draws.uniform("radiance of the rest over that of the ring", 0.01, 0.2)
    light = draws.light("ring", mired=(150, 350))
    away = np.abs(texels.z - height) / width  # [H, 1]
    bright = rest + np.maximum(1 - away, 0)
    return np.asarray(bright[..., None] * np.ones((texels.height, 2 * texels.height, 3)) * light)


SKIES.register("ring", ring)
