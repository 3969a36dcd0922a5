"""An environment map as Mitsuba's `envmap`.

Mitsuba has its axes turned by a cyclic permutation: the middle of its picture is +Z, a quarter from
the left is +X, the top is +Y. And its first and last rows lie on the poles, where ours are half a
texel from them. Rows between ours, of which each is the mean of its neighbours, make both the same
function: its interpolation between them is ours.
"""

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from storage.records.environment import Environment

_TO_OUR_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""X becomes Y, Y becomes Z, Z becomes X."""


def plugin_sky(sky: Environment, sampling_weight: float) -> Any:
    """Return the emitter, picked with a weight beside those of other emitters."""
    to_world = np.eye(4)
    to_world[:3, :3] = sky.rotation.astype(np.float64) @ _TO_OUR_AXES
    return mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(from_pole_to_pole(sky.radiance_rgb)),
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "sampling_weight": sampling_weight,
        }
    )


def from_pole_to_pole(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a map [H, W, 3] as rows [2 H + 1, W, 3] at equal steps, from +Z to -Z."""
    rows = np.zeros((2 * len(radiance_rgb) + 1, *radiance_rgb.shape[1:]), np.float32)
    rows[1::2] = radiance_rgb
    rows[2:-1:2] = (radiance_rgb[:-1] + radiance_rgb[1:]) / 2
    rows[0], rows[-1] = radiance_rgb[0], radiance_rgb[-1]
    return rows
