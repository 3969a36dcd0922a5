"""RenderFormer's published HDF5 file of one scene, written: every array with its quirks.

| array | dtype, shape | meaning |
|---|---|---|
| `triangles` | f32 [T, 3, 3] | vertices of each triangle, world |
| `vn` | f32 [T, 3, 3] | shading normals at them |
| `texture` | f16 or f32 [T, 13, 32, 32] | diffuse 3, specular 3, roughness, normal 3, emission 3 |
| `c2w` | f32 [V, 4, 4] | camera to world, looking along -Z with +Y up |
| `fov` | f32 [V] | full angle in degrees |
| `img` | f16 [V, H, W, 4] | linear radiance, premultiplied RGBA; where there are pictures |
| `mvp` | f32 [V, 4, 4] | world to clip space, near 0.05, far 5; where there are pictures |

- A texture is one value in all of its cells (x, y) with x + y <= 32, which are 559 of 1024; the
  others are zero. It takes 1024 times the bytes of what it says.
- Normals of a texture are (.5, .5, 1): no bump, in the file's tangent space.
- An emitter's texture says diffuse (1, 1, 1) and roughness 1, as published, though our emitters
  reflect nothing (as do the published ones when rendered).
- Half floats end at 65504 and keep 11 bits: albedos move by up to 2^-11, and brighter lights are
  refused.
- Every array is packed by gzip at level 9, in chunks of h5py's choosing.
- Our pictures have no alpha: it is written as 1, and the empty background is radiance zero.
- `mvp` is OpenGL's, for column vectors; the published training multiplies it by zero.

What a file cannot say: which triangles are one object, names and rights, provenance, shared
vertices. `pipeline.exchange.renderformer_h5_read` reads it.
"""

import io
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from storage.atomic import write_atomically
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, PUBLISHED_COLUMNS, REFLECTING, SPECULAR
from storage.records.scene import Scene

CARRIED = frozenset(
    {"vertex_positions", "vertex_normals", "faces", "material_index", "c2w", "fov_deg"}
    | {f"materials.{name}" for name in PUBLISHED_COLUMNS}
)
"""Of a scene (storage.records.carried)."""

CHANNELS, CELLS = 13, 32
"""Of a texture; it has CELLS x CELLS cells."""
TEXTURE_EMISSION = slice(10, 13)
TEXTURE_NORMAL = slice(7, 10)
"""Channels of a texture row; those before them are REFLECTING (storage.records.material)."""
FLAT_NORMAL = (0.5, 0.5, 1.0)
NEAR, FAR = 0.05, 5.0
"""Of `mvp`, in metres."""
GZIP_LEVEL = 9

TextureType = Literal["float16", "float32"]


def filled_cells() -> NDArray[np.bool_]:
    """Return which cells [32, 32] of a texture hold its value: those with x + y <= 32."""
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS))
    return x + y <= CELLS


def write_renderformer_h5(
    path: Path,
    scene: Scene,
    radiance_rgb: NDArray[np.float32] | None = None,
    *,
    texture_type: TextureType = "float32",
) -> None:
    """Write a scene, and its pictures [V, R, R, 3] if given; equal scenes give equal bytes.

    `float16` is what the public converter writes, `float32` what the authors' later tools do. The
    file appears whole or not at all; in memory it takes its packed size and one block of textures.

    Raises:
        TrilightError: a value that half floats do not hold, or the file cannot be written.
    """
    import h5py

    texture = texture_rows(scene, texture_type)
    corners = scene.faces.astype(np.int64)
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        _write(file, "triangles", scene.vertex_positions[corners])
        _write(file, "vn", scene.vertex_normals[corners])
        _write_texture(file, texture)
        _write(file, "c2w", scene.c2w)
        _write(file, "fov", scene.fov_deg)
        if radiance_rgb is not None:
            _write(file, "img", _rgba(radiance_rgb))
            _write(file, "mvp", _mvp(scene))
    write_atomically(path, stream.getvalue())


def texture_rows(scene: Scene, texture_type: TextureType) -> NDArray[np.floating]:
    """Return the value [T, 13] of each triangle's texture.

    Where rounding to half floats would make albedos add up to more than 1, they are rounded down.

    Raises:
        TrilightError: an emission that half floats turn into infinity or nothing.
    """
    emits = np.any(scene.materials[:, EMISSION] > 0, axis=1)
    rows = np.zeros((len(scene.materials), CHANNELS), np.float32)
    rows[:, REFLECTING] = scene.materials[:, REFLECTING]
    rows[emits, REFLECTING] = [1, 1, 1, 0, 0, 0, 1]
    rows[:, TEXTURE_NORMAL] = FLAT_NORMAL
    rows[:, TEXTURE_EMISSION] = scene.materials[:, EMISSION]
    if texture_type == "float32":
        return rows[scene.material_index]
    with np.errstate(over="ignore"):
        half = rows.astype(np.float16)
    lit = half[:, TEXTURE_EMISSION]
    if not np.isfinite(lit).all() or (lit.any(axis=1) != emits).any():
        bad = rows[~np.isfinite(lit).all(axis=1) | (lit.any(axis=1) != emits)][0]
        raise TrilightError(
            f"emission is {bad[TEXTURE_EMISSION]}; half floats hold 6e-8 to {HALF_FLOAT_MAX:.0f}. "
            "Write float32 textures."
        )
    total = half[:, DIFFUSE].astype(np.float32) + half[:, SPECULAR]
    over = np.tile(total > 1, (1, 2))
    albedos = slice(DIFFUSE.start, SPECULAR.stop)
    lower = np.nextafter(half[:, albedos], np.float16(0))
    rises = half[:, albedos] > rows[:, albedos]
    half[:, albedos] = np.where(over & rises, lower, half[:, albedos])
    return half[scene.material_index]


def reflecting_emitters(scene: Scene) -> tuple[str, ...]:
    """Return what a file says otherwise, for people: what emitters reflect, where they do."""
    emits = (scene.materials[:, EMISSION] > 0).any(axis=1)
    reflects = (scene.materials[emits][:, : SPECULAR.stop] > 0).any(axis=1)
    return (f"what {int(reflects.sum())} emitting materials reflect",) if reflects.any() else ()


def _write(file: Any, name: str, values: NDArray) -> None:
    file.create_dataset(name, data=values, compression="gzip", compression_opts=GZIP_LEVEL)


def _write_texture(file: Any, rows: NDArray[np.floating]) -> None:
    """Write textures a block of triangles at a time: whole, they take 53 kB a triangle."""
    shape = (len(rows), CHANNELS, CELLS, CELLS)
    texture = file.create_dataset(
        "texture", shape, rows.dtype, compression="gzip", compression_opts=GZIP_LEVEL
    )
    filled, step = filled_cells(), texture.chunks[0]
    for start in range(0, len(rows), step):
        block = rows[start : start + step, :, None, None]
        texture[start : start + step] = np.where(filled, block, rows.dtype.type(0))


def _rgba(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float16]:
    legal = np.isfinite(radiance_rgb) & (radiance_rgb >= 0) & (radiance_rgb <= HALF_FLOAT_MAX)
    if not legal.all():
        raise TrilightError(
            f"picture: holds {radiance_rgb[~legal][0]}; expected values in [0, "
            f"{HALF_FLOAT_MAX:.0f}]."
        )
    opaque = np.ones((*radiance_rgb.shape[:3], 1), np.float16)
    return np.concatenate([radiance_rgb.astype(np.float16), opaque], axis=3)


def _mvp(scene: Scene) -> NDArray[np.float32]:
    focal = 1 / np.tan(np.radians(scene.fov_deg.astype(np.float64)) / 2)
    clip = np.zeros((len(focal), 4, 4))
    clip[:, 0, 0] = clip[:, 1, 1] = focal
    clip[:, 2, 2], clip[:, 2, 3] = (FAR + NEAR) / (NEAR - FAR), 2 * FAR * NEAR / (NEAR - FAR)
    clip[:, 3, 2] = -1
    view = np.linalg.inv(scene.c2w.astype(np.float64))
    return np.einsum("vij,vjk->vik", clip, view).astype(np.float32)
