"""Albedos of a scene file that add up to more than 1: made lawful, or refused.

Such a surface gives off more light than it gets; published scene files have some (1.1). Scaled,
both albedos of the material are multiplied by one number, 1 / their largest sum over the channels.
One number for all channels keeps the hue of both, and one for both keeps how glossy the surface is
against how coloured; a number for each channel would bleach a red of 1.1 towards white.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.scene import ALBEDO_SUM_TOLERANCE

AlbedoOverOne = Literal["scale", "refuse"]
"""What to do with materials whose diffuse and specular albedos add up to more than 1."""


def lawful_albedos(
    diffuse: NDArray[np.float64], specular: NDArray[np.float64], over_one: AlbedoOverOne
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return albedos that add up to at most 1, and by what the darkened ones were multiplied.

    Args:
        diffuse: [M, 3] of M materials.
        specular: [3] of all of them.
        over_one: whether to scale materials beyond 1.

    Returns:
        Diffuse and specular albedos [M, 3], and the smallest factor of a material; 1.0 where none
        was beyond 1, and then both are what was given.

    Raises:
        TrilightError: a material is beyond 1, and that is to be refused.
    """
    both = np.broadcast_to(specular, diffuse.shape)
    sums = (diffuse + both).max(axis=1)
    beyond = sums > 1 + ALBEDO_SUM_TOLERANCE
    if not beyond.any():
        return diffuse, both, 1.0
    if over_one == "refuse":
        raise TrilightError(
            f"diffuse + specular is {sums.max():.4f}; expected at most 1 in every channel: lower "
            "one, or say --albedo-over-one scale."
        )
    factors = np.where(beyond, 1 / np.where(beyond, sums, 1), 1.0)
    return diffuse * factors[:, None], both * factors[:, None], float(factors.min())
