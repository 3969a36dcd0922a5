"""Pictures by part: direct and indirect light, diffuse and specular, whose sum is the picture.

Direct light reaches the camera by one reflection: lamp, surface, camera. All other light that is
seen is indirect, since emitters are hidden from cameras. Diffuse and specular are the lobes of the
surface that the camera sees, whatever happened to the light before.

The member `0.parts.exr` of a sample holds each part as channels `<part>.R/G/B` of half floats, or
`light<i>.<part>.R/G/B` where lights are apart (storage.records.lights). A picture, or that of a
light, is by definition what `sum_of_parts` returns of them.
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr_layers import decode_layers, encode_layers
from storage.records.lights import MAX_LIGHTS, sum_of_lights

Parts = Mapping[str, NDArray[np.float32]]
"""Radiance by the name of the part, in the order of `part_names`."""

MAX_PICTURES = MAX_LIGHTS
"""Most pictures of one view that are kept apart: parts times lights."""

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
    """Return the pictures that parts, as stored, add up to: equal to them in every bit.

    Sums are taken in float32, part after part, and rounded to half floats once.
    """
    return sum_of_lights(np.stack(list(parts_rgb.values())))


def part_layers(parts_rgb: Parts) -> tuple[list[str], NDArray[np.float32]]:
    """Return the names of the layers of one view's parts, and their pictures [N, R, R, 3].

    Args:
        parts_rgb: [R, R, 3] each, or [L, R, R, 3] of L lights apart.
    """
    stacked = np.stack(list(parts_rgb.values()))
    num_lights = stacked.shape[1] if stacked.ndim == 5 else None
    return _layers(tuple(parts_rgb), num_lights), stacked.reshape(-1, *stacked.shape[-3:])


def encode_parts_exr(parts_rgb: Parts) -> bytes:
    """Return the OpenEXR file of one view's parts, as `part_layers`.

    Raises:
        TrilightError: a value is not finite, negative, or too large for a half float.
    """
    return encode_layers(*part_layers(parts_rgb))


def decode_parts_exr(
    data: bytes, names: Sequence[str], size: tuple[int, int], num_lights: int | None
) -> dict[str, NDArray[np.float32]]:
    """Return the parts of an OpenEXR file, float32 [H, W, 3], or [L, H, W, 3] of lights apart.

    Args:
        data: the file.
        names: of the parts as they must be.
        size: H and W as they must be.
        num_lights: L as it must be; None where lights are together.

    Raises:
        TrilightError: not an EXR file, truncated, or with other channels or another size.
    """
    layers = _layers(names, num_lights)
    if len(layers) > MAX_PICTURES:
        raise TrilightError(f"parts: {len(layers)} pictures; expected at most {MAX_PICTURES}.")
    pictures = decode_layers(data, layers, size, "parts")
    lights = () if num_lights is None else (num_lights,)
    return dict(zip(names, pictures.reshape(len(names), *lights, *size, 3), strict=True))


def _layers(names: Sequence[str], num_lights: int | None) -> list[str]:
    if num_lights is None:
        return list(names)
    return [f"light{light}.{name}" for name in names for light in range(num_lights)]
