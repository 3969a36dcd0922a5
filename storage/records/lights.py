"""Pictures by light (OLAT): what each emitter adds, and the rule that their sum is the picture.

Light i is the i-th object of kind `emitter`, in the order of `Scene.objects`; a sky that shines is
one more light, the last one. The member
`0.lights.exr` of a sample holds the radiance of each alone, as channels `light<i>.R/G/B` of half
floats. The picture is by definition what `sum_of_lights` returns of them, so a reader can turn
lights off, brighten or colour them and knows the result to the rounding of the stored halves.
"""

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.exr import to_half
from storage.records.exr_layers import decode_layers, encode_layers
from storage.records.scene import Scene

MAX_LIGHTS = 64
"""Most lights whose pictures are kept apart: each takes as much room as a picture."""


def num_lights(scene: Scene) -> int:
    """Return the number of emitter objects."""
    return len(light_rows(scene))


def num_light_pictures(scene: Scene) -> int:
    """Return the number of lights whose pictures add up to that of a scene: the sky is one."""
    return num_lights(scene) + (shining_sky(scene) is not None)


def shining_sky(scene: Scene) -> Environment | None:
    """Return the environment of a scene, or None where there is none, or one without any light."""
    sky = scene.environment
    return sky if sky is not None and sky.radiance_rgb.any() else None


def light_rows(scene: Scene) -> tuple[int, ...]:
    """Return the rows of `scene.objects` that are emitters, in order: light i is row `rows[i]`."""
    return tuple(row for row, entry in enumerate(scene.objects) if entry.kind == "emitter")


def rounded_to_half(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return radiance as it comes back from a file, as float32."""
    return to_half(radiance_rgb).astype(np.float32)


def sum_of_lights(lights_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the picture [R, R, 3] that lights [L, R, R, 3], as stored, add up to.

    Sums are taken in float32, light after light, and rounded to half floats once: equal to the
    stored picture in every bit. A sum that half floats cannot hold is infinite.
    """
    total = np.zeros(lights_rgb.shape[1:], np.float32)
    for light in lights_rgb:
        total += light
    with np.errstate(over="ignore"):
        return total.astype(np.float16).astype(np.float32)


def encode_lights_exr(lights_rgb: NDArray[np.float32]) -> bytes:
    """Return the OpenEXR file of lights [L, R, R, 3].

    Raises:
        TrilightError: a value is not finite, negative, or too large for a half float.
    """
    return encode_layers(_layers(len(lights_rgb)), lights_rgb)


def decode_lights_exr(data: bytes, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Return the lights of an OpenEXR file, float32 [L, H, W, 3].

    Args:
        data: the file.
        shape: L, H and W as they must be.

    Raises:
        TrilightError: not an EXR file, truncated, or with other channels or another size.
    """
    num, height, width = shape
    if num > MAX_LIGHTS:
        raise TrilightError(f"lights: {num} pictures; expected at most {MAX_LIGHTS}.")
    return decode_layers(data, _layers(num), (height, width), "lights")


def _layers(num: int) -> list[str]:
    return [f"light{light}" for light in range(num)]
