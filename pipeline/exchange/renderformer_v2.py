"""Reads lights and environment from a file of RenderFormer's successor.

Its `texture` holds [T, 16, 32, 32] cells, or their code by an image encoder. Nine of the 16
channels are a BRDF as a learned network encodes it, which no formula turns back into albedos;
`light_strength` [T, 3] and `env_map` hold everything else. So surfaces become grey, with a note.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.renderformer_stored import (
    CHANNELS,
    FLAT_NORMAL,
    MAX_TRIANGLES,
    TEXTURE_EMISSION,
    TEXTURE_NORMAL,
    StoredTextures,
)
from pipeline.exchange.safe_h5 import list_names, plain_array, read_whole
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.exr import MAX_RESOLUTION
from storage.records.material import DIFFUSE, REFLECTING, ROUGHNESS
from storage.records.texture import MapSource

KNOWN = ("env_map", "env_map_rotation", "env_map_strength", "light_strength")
"""Arrays that this module reads, in addition to those of the first version."""

_GREY = 0.5


def is_second_version(file: Any) -> bool:
    """Return whether an open file has the separate lights of the successor."""
    return "light_strength" in list_names(file)


def read_grey_textures(file: Any, count: int, lost: list[str]) -> StoredTextures:
    """Return grey surfaces with the emission of a file.

    Args:
        file: its root group.
        count: number of its triangles.
        lost: receives a sentence for each loss.

    Raises:
        TrilightError: the array is unusable (`plain_array`), or a value is not finite.
    """
    light = read_whole(plain_array(file, "light_strength", (count, 3), MAX_TRIANGLES))
    rows = np.zeros((count, CHANNELS), np.float32)
    rows[:, DIFFUSE] = _GREY
    rows[:, ROUGHNESS] = 1
    rows[light.any(axis=1), REFLECTING] = [1, 1, 1, 0, 0, 0, 1]  # as in the first version
    rows[:, TEXTURE_NORMAL] = FLAT_NORMAL
    rows[:, TEXTURE_EMISSION] = light
    lost.append(
        f"materials: nine channels of a learned code for a BRDF, which no formula turns into "
        f"albedos; all {count} triangles are a diffuse grey of {_GREY}"
    )
    return StoredTextures(rows=rows, varies=np.zeros(count, np.bool_), cells=None)


def read_sky(file: Any, licence: str, lost: list[str]) -> Environment | None:
    """Return the environment of a file, invisible to cameras; None where it has none.

    The axes are those of `Environment`: the middle is +X, a quarter from the left +Y, the top +Z.

    Raises:
        TrilightError: the map is unusable (`plain_array`) or of another shape.
    """
    if "env_map" not in list_names(file):
        return None
    values = read_whole(plain_array(file, "env_map", (None, None, None), MAX_RESOLUTION))
    if 3 not in (values.shape[0], values.shape[2]):
        raise TrilightError(
            f"env_map has shape {values.shape}; expected (3, H, 2 H) or (H, 2 H, 3)."
        )
    is_processed = values.shape[0] == 3  # a processed map is already rotated and scaled
    radiance = np.moveaxis(values, 0, -1) if is_processed else values
    if not is_processed:
        radiance = radiance * _read_number(file, "env_map_strength", 1.0)
        if np.any(_read_numbers(file, "env_map_rotation")):
            lost.append("rotation of the environment: three angles whose order it does not state")
    if not radiance.any():
        return None  # a black map stands for no environment
    return Environment(
        radiance_rgb=np.ascontiguousarray(radiance, np.float32),
        source=MapSource(name="env_map", licence=licence),
    )


def _read_number(file: Any, name: str, default: float) -> np.float32:
    values = _read_numbers(file, name)
    return np.float32(values.ravel()[0]) if values.size == 1 else np.float32(default)


def _read_numbers(file: Any, name: str) -> NDArray[np.float32]:
    """Read a small array of a file; empty where the file lacks it."""
    if name not in list_names(file):
        return np.zeros(0, np.float32)
    try:
        return read_whole(plain_array(file, name, (), 1))
    except TrilightError:
        return read_whole(plain_array(file, name, (None,), 16))
