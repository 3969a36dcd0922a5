"""Pictures by light (OLAT) and by part, and the rule that their sum is the picture.

Light i is the i-th object of kind `emitter`, in the order of `Scene.objects`; a sky that shines is
one more light, the last one. Parts are direct and indirect light, and the diffuse and the specular
lobe. Direct light reaches the camera by one reflection: lamp, surface, camera. All other light that
is seen is indirect, since emitters are hidden from cameras. The lobes are those of the surface that
the camera sees, whatever happened to the light before.

A sample holds the radiance of each alone, as channels of half floats: `light<i>.R/G/B` in the
member `0.lights.exr`, and in `0.parts.exr` `<part>.R/G/B`, or `light<i>.<part>.R/G/B` where lights
are apart. The picture is by definition what `sum_of_lights` returns of them, so a reader can turn
lights off, brighten or colour them and knows the result to the rounding of the stored halves.
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr import decode_layers, encode_layers, to_half
from storage.records.scene import Scene
from storage.records.texture import Environment

MAX_LIGHTS = 64
"""Most pictures of one view that are kept apart, parts times lights: each takes as much room as the
picture."""


def num_lights(scene: Scene) -> int:
    """Return the number of emitter objects."""
    return len(light_rows(scene))


def light_sources(scene: Scene) -> tuple[int | None, ...]:
    """Return the lights whose pictures add up to that of a scene: `light_rows`, None for a sky."""
    sky = () if shining_sky(scene) is None else (None,)
    return (*light_rows(scene), *sky)


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


Parts = Mapping[str, NDArray[np.float32]]
"""Radiance by the name of the part, in the order of `part_names`."""

ALL_LIGHT = ""
"""Name of the only part where lights are apart and parts are not."""

_LOBES = ("diffuse", "specular")
_BOUNCES = ("direct", "indirect")


def part_names(*, bounces: bool, lobes: bool) -> tuple[str, ...]:
    """Return the names of the parts, which other renderers use too; empty where all is together.

    Args:
        bounces: whether direct and indirect light are apart.
        lobes: whether the diffuse and the specular lobe are.
    """
    kinds = [names for names, is_separate in ((_LOBES, lobes), (_BOUNCES, bounces)) if is_separate]
    return tuple("_".join(words) for words in itertools.product(*kinds)) if kinds else ()


KNOWN_PARTS = tuple(
    part_names(bounces=bounces, lobes=lobes)
    for bounces, lobes in ((True, False), (False, True), (True, True))
)
"""The sets of parts that there are."""


def sum_of_parts(parts_rgb: Parts) -> NDArray[np.float32]:
    """Return the pictures that parts, as stored, add up to, as `sum_of_lights` does."""
    return sum_of_lights(np.stack(list(parts_rgb.values())))


def encode_parts_exr(parts_rgb: Parts) -> bytes:
    """Return the OpenEXR file of one view's parts; raises as `encode_layers`.

    Args:
        parts_rgb: [R, R, 3] each, or [L, R, R, 3] of L lights apart; ALL_LIGHT where there are no
            parts.
    """
    stacked = np.stack(list(parts_rgb.values()))
    layers = _layers(tuple(parts_rgb), stacked.shape[1] if stacked.ndim == 5 else None)
    return encode_layers(dict(zip(layers, stacked.reshape(-1, *stacked.shape[-3:]), strict=True)))


def decode_parts_exr(
    data: bytes, names: Sequence[str], size: tuple[int, int], num_lights: int | None
) -> dict[str, NDArray[np.float32]]:
    """Return the parts of an OpenEXR file, float32 [H, W, 3], or [L, H, W, 3] of lights apart.

    `names`, `size` (H and W) and `num_lights` (None where they are together) are as they must be.

    Raises:
        TrilightError: not an EXR file, truncated, or with other channels or another size.
    """
    layers = _layers(names, num_lights)
    what = "parts" if any(names) else "lights"
    if len(layers) > MAX_LIGHTS:
        raise TrilightError(f"{what}: {len(layers)} pictures; expected at most {MAX_LIGHTS}.")
    pictures = decode_layers(data, layers, size, what)
    lights = () if num_lights is None else (num_lights,)
    return dict(zip(names, pictures.reshape(len(names), *lights, *size, 3), strict=True))


def _layers(names: Sequence[str], num_lights: int | None) -> list[str]:
    if num_lights is None:
        return list(names)
    return [f"light{light}.{name}".strip(".") for name in names for light in range(num_lights)]
