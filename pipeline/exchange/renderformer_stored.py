"""Reads the textures of a RenderFormer file: their means, and the cells of varying ones.

In a file of RenderFormer's successor, `texture` holds [T, 16, 32, 32] cells, or their code by an
image encoder. Nine of the 16 channels are a BRDF as a learned network encodes it, which no formula
turns back into albedos; `light_strength` [T, 3] and `env_map` hold everything else. So its surfaces
become grey, with a note.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.renderformer_cells import CELLS, MAX_VARYING, build_atlas, filled_cell_mask
from pipeline.exchange.safe_h5 import (
    iterate_blocks,
    list_names,
    plain_array,
    read_whole,
    require_finite,
)
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.exr import MAX_RESOLUTION
from storage.records.material import DIFFUSE, REFLECTING, ROUGHNESS
from storage.records.retextured import with_textures, without_constant_textures
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, MapSource

MAX_TRIANGLES = 1_000_000

CHANNELS = 13
"""A texture has CHANNELS channels of CELLS x CELLS cells."""
TEXTURE_EMISSION = slice(10, 13)
TEXTURE_NORMAL = slice(7, 10)
"""Channels of a texture row; those before them are REFLECTING (storage.records.material)."""
FLAT_NORMAL = (0.5, 0.5, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredTextures:
    """Means and varying cells of the textures of all triangles."""

    rows: NDArray[np.float32]
    """[T, 13] mean of each texture."""
    varies: NDArray[np.bool_]
    """[T] True where the cells of a texture differ."""
    cells: NDArray[np.float32] | None
    """[N, 7, 32, 32] reflectance cells of the varying textures; None where none varies."""


def read_textures(file: Any, count: int, lost: list[str]) -> StoredTextures:
    """Read the textures of an open file.

    Args:
        file: its root group.
        count: number of its triangles.
        lost: receives a sentence for each loss.

    Raises:
        TrilightError: the array is unusable (`plain_array`, `iterate_blocks`), or not finite.
    """
    rows, varies = _texture_rows(file, count, lost)
    cells = _varying_cells(file, count, varies) if varies.any() else None
    return StoredTextures(rows=rows, varies=varies, cells=cells)


def with_cells(scene: Scene, stored: StoredTextures, licence: str) -> Scene:
    """Return a scene with the textures of its cells; varying triangles share a material."""
    varies = stored.varies
    if stored.cells is None:
        return scene
    atlas = build_atlas(stored.cells, MapSource(name="cells of triangles", licence=licence))
    uv = np.zeros((scene.num_triangles, 3, 2), np.float32)
    uv[varies] = atlas.uv
    index = np.full((len(scene.materials), len(TEXTURED)), CONSTANT, np.int32)
    textures = list({texture.sha256: texture for texture in atlas.textures}.values())
    index[np.unique(scene.material_index[varies])] = [
        [one.sha256 for one in textures].index(texture.sha256) for texture in atlas.textures
    ]
    scene = with_textures(scene, uv.reshape(-1, 2), tuple(textures), index)
    return without_constant_textures(scene)


def _texture_rows(
    file: Any, count: int, lost: list[str]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the mean [T, 13] of each texture, and a mask [T] of those to read by cell.

    One block of cells is in memory at a time.
    """
    texture = plain_array(file, "texture", (count, CHANNELS, CELLS, CELLS), MAX_TRIANGLES)
    filled = filled_cell_mask()
    low = np.full((count, CHANNELS), np.inf, np.float32)
    high = -low
    total = np.zeros((count, CHANNELS))
    for where, block in iterate_blocks(texture):
        rows = where[:2]
        cells = filled[where[2:]]
        if cells.any():
            require_finite(texture, block[:, :, cells])
            values = block[:, :, cells].astype(np.float32)
            low[rows] = np.minimum(low[rows], values.min(axis=2))
            high[rows] = np.maximum(high[rows], values.max(axis=2))
            total[rows] += values.sum(axis=2, dtype=np.float64)
    emits = (total[:, TEXTURE_EMISSION] > 0).any(axis=1)
    differs = low != high
    varies = differs[:, REFLECTING].any(axis=1) & ~emits
    glows = differs[:, TEXTURE_EMISSION].any(axis=1)
    if varies.sum() > MAX_VARYING:
        lost.append(f"varying textures of {varies.sum()} triangles: replaced by their means")
        varies[:] = False
    if glows.any():
        lost.append(f"varying emission of {glows.sum()} triangles: replaced by its mean")
    bumpy = (low[:, TEXTURE_NORMAL] != np.array(FLAT_NORMAL, np.float32)).any(axis=1)
    if bumpy.any():
        lost.append(f"normal textures of {bumpy.sum()} triangles")
    mean = (total / filled.sum()).astype(np.float32)
    return np.where(differs, mean, low), varies


def _varying_cells(file: Any, count: int, varies: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the reflectance cells [N, 7, 32, 32] of the triangles with varying textures."""
    texture = plain_array(file, "texture", (count, CHANNELS, CELLS, CELLS), MAX_TRIANGLES)
    cells = np.zeros((int(varies.sum()), CHANNELS, CELLS, CELLS), np.float32)
    rank = np.cumsum(varies) - 1
    for where, block in iterate_blocks(texture):
        chosen = np.flatnonzero(varies[where[0]])
        cells[rank[where[0]][chosen], where[1], where[2], where[3]] = block[chosen]
    return cells[:, REFLECTING]


SECOND_VERSION = ("env_map", "env_map_rotation", "env_map_strength", "light_strength")
"""Arrays of the successor, in addition to those of the first version."""

_GREY = 0.5


def is_second_version(file: Any) -> bool:
    """Return whether an open file has the separate lights of the successor."""
    return "light_strength" in list_names(file)


def read_grey_textures(file: Any, count: int, lost: list[str]) -> StoredTextures:
    """Return grey surfaces with the emission of a successor's file, as `read_textures`."""
    light = read_whole(plain_array(file, "light_strength", (count, 3), MAX_TRIANGLES))
    rows = np.zeros((count, CHANNELS), np.float32)
    rows[:, DIFFUSE] = _GREY
    rows[:, ROUGHNESS] = 1
    rows[light.any(axis=1), REFLECTING] = [1, 1, 1, 0, 0, 0, 1]  # as in the first version
    rows[:, TEXTURE_NORMAL] = FLAT_NORMAL
    rows[:, TEXTURE_EMISSION] = light
    lost.append(
        f"materials: nine channels of a learned code for a BRDF, which no formula turns into "
        f"albedos; all {count} triangles are a diffuse gray of {_GREY}"
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
        strength = _read_numbers(file, "env_map_strength").ravel()
        radiance = radiance * (strength[0] if strength.size == 1 else np.float32(1))
        if np.any(_read_numbers(file, "env_map_rotation")):
            lost.append("rotation of the environment: three angles whose order it does not state")
    if not radiance.any():
        return None  # a black map stands for no environment
    return Environment(
        radiance_rgb=np.ascontiguousarray(radiance, np.float32),
        source=MapSource(name="env_map", licence=licence),
    )


def _read_numbers(file: Any, name: str) -> NDArray[np.float32]:
    """Read a small array of a file; empty where the file lacks it."""
    if name not in list_names(file):
        return np.zeros(0, np.float32)
    try:
        return read_whole(plain_array(file, name, (), 1))
    except TrilightError:
        return read_whole(plain_array(file, name, (None,), 16))
