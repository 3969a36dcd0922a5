"""Reads and writes the published RenderFormer HDF5 file of one scene.

| array | dtype, shape | meaning |
|---|---|---|
| `triangles` | f32 [T, 3, 3] | vertices of each triangle, world |
| `vn` | f32 [T, 3, 3] | shading normals at them |
| `texture` | f16 or f32 [T, 13, 32, 32] | diffuse 3, specular 3, roughness, normal 3, emission 3 |
| `c2w` | f32 [V, 4, 4] | camera to world, looking along -Z with +Y up |
| `fov` | f32 [V] | full angle in degrees |
| `img` | f16 [V, H, W, 4] | linear radiance, premultiplied RGBA; where there are pictures |
| `mvp` | f32 [V, 4, 4] | world to clip space, near 0.05, far 5; where there are pictures |

- A texture lies in 32 x 32 cells as a right triangle: the column x of a cell is the weight of the
  first vertex and its row y that of the second, in 32nds, so that the third vertex is at the corner
  x = y = 0. The cells with x + y <= 32, which are 559 of 1024, hold the mean of the texture over
  their area inside the triangle, those beyond it continue the texture; the others are zero.
- Published files hold one value in all cells; the successor fills them. When read, every triangle
  whose cells vary becomes a square of an atlas, with a border of one cell so that no look-up
  touches a neighbor.
- The normal channels are (.5, .5, 1): no bump, in the file's tangent space.
- The texture of an emitter states diffuse (1, 1, 1) and roughness 1, as published, though emitters
  reflect nothing here (nor do the published ones when rendered).
- The public converter writes textures as half floats, which end at 65504 and keep 11 bits. Ours are
  float32, as those of the authors' later tools.
- Every array is compressed by gzip at level 9, in chunks that h5py chooses.
- Pictures have no alpha here: it is written as 1, and the empty background is radiance zero.
- `mvp` is OpenGL's, for column vectors; the published training multiplies it by zero.

The file has no place for objects (which triangles belong together), names and rights, provenance,
or shared vertices. The reader does not trust the file (pipeline.exchange.safe_h5).

A file of RenderFormer's successor holds [T, 16, 32, 32] cells, or their code by an image encoder.
Nine of the 16 channels are a BRDF as a learned network encodes it, which no formula turns back into
albedos; `light_strength` [T, 3] and `env_map` hold everything else. So its surfaces become grey,
with a note.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.exchange.safe_h5 import (
    iterate_blocks,
    open_h5,
    plain_array,
    read_whole,
    require_finite,
)
from pipeline.exchange.textured_triangles import (
    MAX_ROWS,
    NO_TEXTURES,
    LoadedScene,
    add_textures,
    color_textures,
    index_corners,
    number_texture,
    used_textures,
)
from pipeline.objects.licences import UNKNOWN
from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.records.exr import MAX_RESOLUTION, to_half
from storage.records.lookup import texture_values
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    REFLECTING,
    ROUGHNESS,
    SPECULAR,
    column_places,
    default_rows,
    distinct_rows,
)
from storage.records.scene import (
    ALBEDO_SUM_TOLERANCE,
    UNIT_NORMAL_TOLERANCE,
    ObjectKind,
    Scene,
    SceneObject,
)
from storage.records.texture import CONSTANT, Environment, MapSource, Texture

CHANNELS = 13
CELLS = 32
"""A texture has CHANNELS channels of CELLS x CELLS cells."""
FILLED_CELLS = np.add.outer(np.arange(CELLS), np.arange(CELLS)) <= CELLS
"""Mask [32, 32] of the cells that hold a texture: those with x + y <= 32."""
_NORMAL = slice(7, 10)
_EMISSION = slice(10, 13)
"""Channels of a texture row; those before them are REFLECTING (storage.records.material)."""
_FLAT_NORMAL = (0.5, 0.5, 1.0)
_PUBLISHED_EMITTER = (1, 1, 1, 0, 0, 0, 1)
"""What the reflecting channels of an emitter state."""

NEAR = 0.05
FAR = 5.0
"""Clip distances of `mvp`, in meters."""
GZIP_LEVEL = 9  # to h5py, a bare number is a level of gzip


def write_renderformer_h5(
    path: Path,
    scene: Scene,
    radiance_rgb: NDArray[np.float32] | None = None,
) -> tuple[str, ...]:
    """Write a scene, and its pictures [V, R, R, 3] if given; equal scenes give equal bytes.

    The file appears whole or not at all; memory is its compressed size and one block of textures.

    Returns:
        Sentences about members in the file that lose something.

    Raises:
        TrilightError: a picture exceeds half floats, or the file cannot be written.
    """
    import h5py

    corners = scene.faces.astype(np.int64)
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        _write(file, "triangles", scene.vertex_positions[corners])
        _write(file, "vn", scene.vertex_normals[corners])
        rows = _stated_rows(scene.materials[:, REFLECTING], scene.materials[:, EMISSION])
        _write_texture(file, rows[scene.material_index], scene)
        _write(file, "c2w", scene.c2w)
        _write(file, "fov", scene.fov_deg)
        if radiance_rgb is not None:
            opaque = np.ones((*radiance_rgb.shape[:3], 1), np.float16)
            _write(file, "img", np.concatenate([to_half(radiance_rgb), opaque], axis=3))
            _write(file, "mvp", _mvp(scene))
    write_atomically(path, stream.getvalue())
    lost = []
    reflects = (scene.materials[:, : SPECULAR.stop] > 0).any(axis=1)
    reflects &= (scene.materials[:, EMISSION] > 0).any(axis=1)
    if reflects.any():
        lost.append(f"albedos of {int(reflects.sum())} emitting materials")
    if count := int(textured_triangles(scene).sum()):
        lost.append(f"more of {count} textured triangles than the means of 32 x 32 cells each")
    return tuple(lost)


def _stated_rows(reflecting: ArrayLike, emission: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values [N, 13] of textures, of emission [N, 3] and the channels that reflect."""
    rows = np.zeros((len(emission), CHANNELS), np.float32)
    rows[:, REFLECTING] = reflecting
    rows[(emission > 0).any(axis=1), REFLECTING] = _PUBLISHED_EMITTER
    rows[:, _NORMAL] = _FLAT_NORMAL
    rows[:, _EMISSION] = emission
    return rows


def _write(file: Any, name: str, values: NDArray) -> None:
    file.create_dataset(name, data=values, compression=GZIP_LEVEL)


def _write_texture(file: Any, rows: NDArray[np.float32], scene: Scene) -> None:
    """Write textures in blocks of triangles; in memory each triangle takes 53 kB."""
    textured = textured_triangles(scene)
    shape = (len(rows), CHANNELS, CELLS, CELLS)
    texture = file.create_dataset("texture", shape, rows.dtype, compression=GZIP_LEVEL)
    step = texture.chunks[0]
    for start in range(0, len(rows), step):
        block = rows[start : start + step, :, None, None]
        cells = np.where(FILLED_CELLS, block, rows.dtype.type(0))
        for triangle in start + np.flatnonzero(textured[start : start + step]):
            for part, values in compute_cells(scene, int(triangle)):
                cells[triangle - start, part] = values
        texture[start : start + step] = cells


def _mvp(scene: Scene) -> NDArray[np.float32]:
    focal = 1 / np.tan(np.radians(scene.fov_deg.astype(np.float64)) / 2)
    clip = np.zeros((len(focal), 4, 4))
    clip[:, 0, 0] = clip[:, 1, 1] = focal
    clip[:, 2, 2] = (FAR + NEAR) / (NEAR - FAR)
    clip[:, 2, 3] = 2 * FAR * NEAR / (NEAR - FAR)
    clip[:, 3, 2] = -1
    view = np.linalg.inv(scene.c2w.astype(np.float64))
    return np.einsum("vij,vjk->vik", clip, view).astype(np.float32)


MAX_TRIANGLES = 1_000_000
MAX_VIEWS = 1000
MAX_PICTURE_BYTES = 1 << 30
"""Maximum bytes of all pictures of a file as float32."""
_GREY = (0.5, 0.5, 0.5, 0, 0, 0, 1)
"""What the reflecting channels of a surface of the successor become."""
_SECOND_VERSION = ("env_map", "env_map_rotation", "env_map_strength", "light_strength")
"""Arrays of the successor, in addition to those of the first version."""
_KNOWN = ("c2w", "fov", "img", "mvp", "texture", "triangles", "vn")
_ROUNDING = 2.0**-10
"""Tolerance for the half-float rounding of albedos that add up to 1."""


def read_renderformer_h5(path: Path, *, pictures: bool = True) -> LoadedScene:
    """Read a file of the published layout, and its pictures where that is asked.

    Corners with equal position and normal become one vertex, so that flat and smooth shading stay
    as they are. Equal materials become one row, but each emitting triangle has a separate row.

    Raises:
        TrilightError: the file has another layout; an array is a link, outside the file, too large
            or not finite (pipeline.exchange.safe_h5); or the scene breaks a law (`Scene.check`).
    """
    lost: list[str] = []
    with open_h5(path) as file:
        second = "light_strength" in sorted(file)
        lost += _list_unknown(file, (*_KNOWN, *(_SECOND_VERSION if second else ())))
        triangles = read_whole(file, "triangles", (None, 3, 3), MAX_TRIANGLES)
        count = len(triangles)
        normals = read_whole(file, "vn", (count, 3, 3), MAX_TRIANGLES)
        rows, varies = (_read_grey_rows if second else _read_rows)(file, count, lost)
        sky = _read_sky(file, lost) if second else None
        c2w = read_whole(file, "c2w", (None, 4, 4), MAX_VIEWS)
        fov_deg = read_whole(file, "fov", (len(c2w),), MAX_VIEWS)
        radiance_rgb = _pictures(file, len(c2w), lost) if "img" in sorted(file) else None
        positions, normals, faces = index_corners(triangles, _normalize(triangles, normals, lost))
        scene = Scene(
            vertex_positions=positions,
            vertex_normals=normals,
            faces=faces,
            **_palette(rows, varies, lost),
            c2w=c2w,
            fov_deg=fov_deg,
            provenance={"template": "renderformer-h5", "file": path.name},
            environment=sky,
        )
        if varies.any():
            scene = _with_cells(scene, _read_cells(file, varies), varies)
        scene.check()
    return LoadedScene(
        scene=scene, radiance_rgb=radiance_rgb if pictures else None, notes=tuple(lost)
    )


def _list_unknown(file: Any, known: Sequence[str]) -> list[str]:
    names = [f"array or group {name!r:.60}" for name in sorted(file) if name not in known]
    names += [f"attribute {name!r:.60}" for name in sorted(file.attrs)]
    return names if len(names) <= 10 else [*names[:10], f"and {len(names) - 10} more"]


def _pictures(file: Any, num_views: int, lost: list[str]) -> NDArray[np.float32]:
    shape = (num_views, None, None, 4)
    rgba = read_whole(file, "img", shape, MAX_RESOLUTION, MAX_PICTURE_BYTES)
    if (rgba[..., 3] != 1).any():
        lost.append("alpha of pictures: composited over black")
    return rgba[..., :3].copy()


def _normalize(
    triangles: NDArray[np.float32], normals: NDArray[np.float32], lost: list[str]
) -> NDArray[np.float32]:
    """Return unit normals [T, 3, 3]; the normal of the face replaces zero normals."""
    length = np.linalg.norm(normals.astype(np.float64), axis=2, keepdims=True)
    off = np.abs(length - 1) > UNIT_NORMAL_TOLERANCE
    if not off.any():
        return normals
    lost.append(f"lengths of {off.sum()} normals that were not 1")
    edges = np.diff(triangles.astype(np.float64), axis=1)
    face = np.cross(edges[:, 0], edges[:, 1])[:, None]
    chosen = np.where(length > 0, normals, face)
    size = np.linalg.norm(chosen, axis=2, keepdims=True)
    if not (size > 0).all():
        at = int(np.argwhere(size[..., 0] <= 0)[0, 0])
        raise TrilightError(f"vn[{at}] is zero, and so is the area of triangle {at}.")
    return np.where(off, chosen / size, normals).astype(np.float32)


def _palette(
    rows: NDArray[np.float32], varies: NDArray[np.bool_], lost: list[str]
) -> dict[str, Any]:
    emits = (rows[:, _EMISSION] > 0).any(axis=1)
    materials = default_rows(len(rows))
    materials[:, REFLECTING] = rows[:, REFLECTING]
    materials[:, EMISSION] = rows[:, _EMISSION]
    if (materials[emits, REFLECTING] != _PUBLISHED_EMITTER).any():
        lost.append("albedos of emitters: emitters of a scene reflect nothing")
    materials[emits, REFLECTING] = [0, 0, 0, 0, 0, 0, 1]
    materials[varies, REFLECTING] = 0  # one row for all of them, since their cells hold the values
    _limit_rounded_albedos(materials, lost)
    order = np.where(emits, np.cumsum(emits), -1.0 * varies)  # equal emitters keep separate rows
    first, index = distinct_rows(np.column_stack([materials, order.astype(np.float32)]))
    if len(first) > MAX_ROWS or emits.sum() >= MAX_ROWS:
        raise TrilightError(
            f"texture: {len(first)} materials and {emits.sum()} emitters; expected at most "
            f"{MAX_ROWS} of each."
        )
    kinds: dict[str, ObjectKind] = {} if emits.all() else {"surfaces": "object"}
    first_emitter = len(kinds)
    kinds |= {f"emitter{row}": "emitter" for row in range(emits.sum())}
    return {
        "materials": materials[first],
        "material_index": index.astype(np.uint16),
        "object_index": (np.where(emits, order - 1 + first_emitter, 0)).astype(np.uint16),
        "objects": tuple(
            SceneObject(name=name, kind=kind, licence=UNKNOWN) for name, kind in kinds.items()
        ),
    }


def _limit_rounded_albedos(materials: NDArray[np.float32], lost: list[str]) -> None:
    """Lower specular albedos whose sum rounding raised above 1, as `Scene.check` demands."""
    excess = materials[:, DIFFUSE] + materials[:, SPECULAR] - 1
    rounded = (excess > ALBEDO_SUM_TOLERANCE) & (excess <= _ROUNDING)
    if rounded.any():
        lost.append("specular albedos lowered where rounding took diffuse + specular above 1")
        materials[:, SPECULAR] = np.where(
            rounded, np.maximum(1 - materials[:, DIFFUSE], 0), materials[:, SPECULAR]
        )


def _read_rows(
    file: Any, count: int, lost: list[str]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the mean [T, 13] of each texture, and a mask [T] of those to read by cell.

    One block of cells is in memory at a time.
    """
    texture = plain_array(file, "texture", (count, CHANNELS, CELLS, CELLS), MAX_TRIANGLES)
    low = np.full((count, CHANNELS), np.inf, np.float32)
    high = -low
    total = np.zeros((count, CHANNELS))
    for where, block in iterate_blocks(texture):
        rows = where[:2]
        cells = FILLED_CELLS[where[2:]]
        if cells.any():
            require_finite(texture, block[:, :, cells])
            values = block[:, :, cells].astype(np.float32)
            low[rows] = np.minimum(low[rows], values.min(axis=2))
            high[rows] = np.maximum(high[rows], values.max(axis=2))
            total[rows] += values.sum(axis=2, dtype=np.float64)
    emits = (total[:, _EMISSION] > 0).any(axis=1)
    differs = low != high
    varies = differs[:, REFLECTING].any(axis=1) & ~emits
    glows = differs[:, _EMISSION].any(axis=1)
    if varies.sum() > MAX_VARYING:
        lost.append(f"varying textures of {varies.sum()} triangles: replaced by their means")
        varies[:] = False
    if glows.any():
        lost.append(f"varying emission of {glows.sum()} triangles: replaced by its mean")
    bumpy = (low[:, _NORMAL] != np.array(_FLAT_NORMAL, np.float32)).any(axis=1)
    if bumpy.any():
        lost.append(f"normal textures of {bumpy.sum()} triangles")
    mean = (total / FILLED_CELLS.sum()).astype(np.float32)
    return np.where(differs, mean, low), varies


def _read_cells(file: Any, varies: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the reflectance cells [N, 7, 32, 32] of the triangles with varying textures."""
    texture = plain_array(file, "texture", (len(varies), CHANNELS, CELLS, CELLS), MAX_TRIANGLES)
    cells = np.zeros((int(varies.sum()), CHANNELS, CELLS, CELLS), np.float32)
    rank = np.cumsum(varies) - 1
    for where, block in iterate_blocks(texture):
        chosen = np.flatnonzero(varies[where[0]])
        cells[rank[where[0]][chosen], where[1], where[2], where[3]] = block[chosen]
    return cells[:, REFLECTING]


def _with_cells(scene: Scene, cells: NDArray[np.float32], varies: NDArray[np.bool_]) -> Scene:
    """Return a scene with the textures of its cells; varying triangles share a material."""
    source = MapSource(name="cells of triangles", licence=UNKNOWN)
    maps, corner_uv = build_atlas(cells, source)
    uv = np.zeros((scene.num_triangles, 3, 2), np.float32)
    uv[varies] = corner_uv
    used = np.isin(np.arange(len(scene.materials)), scene.material_index[varies])
    return add_textures(scene, uv, [maps if is_used else NO_TEXTURES for is_used in used])


def _read_grey_rows(
    file: Any, count: int, lost: list[str]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return grey surfaces with the emission of a successor's file, as `_read_rows`."""
    light = read_whole(file, "light_strength", (count, 3), MAX_TRIANGLES)
    lost.append(
        f"materials: nine channels of a learned code for a BRDF, which no formula turns into "
        f"albedos; all {count} triangles are a diffuse gray of {_GREY[0]}"
    )
    return _stated_rows(_GREY, light), np.zeros(count, np.bool_)


def _read_sky(file: Any, lost: list[str]) -> Environment | None:
    """Return the environment of a file, invisible to cameras; None where it has none.

    The axes are those of `Environment`: the middle is +X, a quarter from the left +Y, the top +Z.

    Raises:
        TrilightError: the map is unusable (`plain_array`) or of another shape.
    """
    if "env_map" not in sorted(file):
        return None
    values = read_whole(file, "env_map", (None, None, None), MAX_RESOLUTION)
    if values.shape[0] == 3:  # a processed map, which is already rotated and scaled
        radiance = np.moveaxis(values, 0, -1)
    elif values.shape[2] == 3:
        strength = _read_small(file, "env_map_strength").ravel()
        radiance = values * (strength[0] if strength.size == 1 else np.float32(1))
        if np.any(_read_small(file, "env_map_rotation")):
            lost.append("rotation of the environment: three angles whose order it does not state")
    else:
        raise TrilightError(
            f"env_map has shape {values.shape}; expected (3, H, 2 H) or (H, 2 H, 3)."
        )
    if not radiance.any():
        return None  # a black map stands for no environment
    return Environment(
        radiance_rgb=np.ascontiguousarray(radiance, np.float32),
        source=MapSource(name="env_map", licence=UNKNOWN),
    )


def _read_small(file: Any, name: str) -> NDArray[np.float32]:
    """Read a small array of a file; empty where the file lacks it."""
    if name not in sorted(file):
        return np.zeros(0, np.float32)
    try:
        return read_whole(file, name, (), 1)
    except TrilightError:
        return read_whole(file, name, (None,), 16)


MAX_VARYING = 8192
"""Maximum number of triangles whose cells become an atlas; each takes 28 kB meanwhile."""

_BORDER = 1
_TILE = CELLS + 2 * _BORDER
_MOST_STEPS = 16  # maximum number of samples along the side of a cell


def textured_triangles(scene: Scene) -> NDArray[np.bool_]:
    """Return a mask [T] of the triangles that have a texture and emit nothing."""
    if scene.material_textures is None:
        return np.zeros(scene.num_triangles, np.bool_)
    textured = (scene.material_textures != CONSTANT).any(axis=1)
    return np.asarray(textured[scene.material_index] & ~scene.triangle_emits)


def compute_cells(scene: Scene, triangle: int) -> list[tuple[slice, NDArray[np.float32]]]:
    """Return the channels and cells [C, 32, 32] of each textured column of a triangle."""
    assert scene.uv is not None
    uv = scene.uv.reshape(-1, 3, 2)[triangle].astype(np.float64)
    used = used_textures(scene, scene.material_index[triangle])
    return [
        (part, _compute_means(used[name][1], uv))
        for name, part in column_places().items()
        if name in used
    ]


def _compute_means(texture: Texture, uv: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the means [C, 32, 32] of a texture over the cells of a triangle with corners [3, 2].

    Samples are as dense as the texels, up to 16 x 16 in a cell.
    """
    height, width = texture.texels.shape[:2]
    edges = (uv[:2] - uv[2]) * [width, height] / CELLS  # in texels, along a cell
    steps = int(np.clip(np.ceil(np.abs(edges).max()), 2, _MOST_STEPS))
    offsets = (np.arange(steps) + 0.5) / steps
    y, x = np.nonzero(FILLED_CELLS)
    one = (x[:, None, None] + offsets) / CELLS
    two = (y[:, None, None] + offsets[:, None]) / CELLS
    weights = np.stack(np.broadcast_arrays(one, two, 1 - one - two), axis=-1)
    values = texture_values(texture, np.einsum("csuk,kd->csud", weights, uv))
    inside = weights[..., 2] >= -1e-9
    inside |= ~inside.any((1, 2), keepdims=True)
    total = np.einsum("csu,csuk->ck", inside.astype(np.float64), values)
    means = np.zeros((texture.channels, CELLS, CELLS), np.float32)
    means[:, y, x] = (total / inside.sum(axis=(1, 2))[:, None]).T
    return means


def build_atlas(
    cells: NDArray[np.float32], source: MapSource
) -> tuple[tuple[Texture, Texture, Texture], NDArray[np.float32]]:
    """Return cells [N, 7, 32, 32] as textures of 8 bits: diffuse, specular and roughness.

    The second value has the texture coordinates [N, 3, 2] of the corners of each triangle.

    The diffuse albedo is lowered where both add up to more than 1. Cells that no look-up reaches
    get the mean of the others, so that a texture's mean is that of its triangles.
    """
    count, channels = cells.shape[:2]
    across = int(np.ceil(np.sqrt(count)))
    up = -(-count // across)
    inner = np.moveaxis(np.clip(cells, 0, 1), 1, -1)
    means = inner[:, FILLED_CELLS].mean(axis=1)
    inner = np.where(FILLED_CELLS[..., None], inner, means[:, None, None])
    tiles = np.zeros((across * up, _TILE, _TILE, channels), np.float32) + means.mean(axis=0)
    tiles[:count] = np.pad(inner, ((0, 0), (_BORDER, _BORDER), (_BORDER, _BORDER), (0, 0)), "edge")
    sheet = tiles.reshape(up, across, _TILE, _TILE, channels).swapaxes(1, 2)
    sheet = sheet.reshape(up * _TILE, across * _TILE, channels)
    colors = color_textures(sheet[..., DIFFUSE], sheet[..., SPECULAR], source)
    roughness = number_texture(sheet[..., ROUGHNESS : ROUGHNESS + 1], source)
    row, column = np.divmod(np.arange(count), across)
    corner = np.stack([column, row], axis=-1)[:, None] * _TILE + _BORDER
    offsets = np.array([[CELLS, 0], [0, CELLS], [0, 0]])
    uv = (corner + offsets) / [across * _TILE, up * _TILE]
    return (*colors, roughness), uv.astype(np.float32)
