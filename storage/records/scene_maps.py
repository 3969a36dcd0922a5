"""Laws of the textures and the environment of a scene.

A scene that has no textures has no texture coordinates and no `material_textures` either: the three
come together. A texture stands in the place of one of the columns TEXTURED; what the material row
itself says there counts for nothing, and is by convention the texture's mean, for readers that know
no textures. Or it is a normal map, which stands in the place of no column.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from storage.records.lookup import texture_values
from storage.records.material import column_places, laid_out
from storage.records.scene_laws import broken_law, require_array, require_law
from storage.records.texture import CONSTANT, MAX_MAPS_BYTES, TEXTURED, Texture

if TYPE_CHECKING:
    from storage.records.scene import Scene

MAX_TEXTURES = 4096
"""Most textures of a scene."""

MAX_UV = 1024.0
"""Farthest texture coordinate. Float32 knows such ones to 6e-5, which is one texel of the largest
texture."""

SUM_TOLERANCE = 1e-5
"""As that of constant albedos (storage.records.scene)."""

MAP_ARRAYS: Mapping[str, tuple[type, tuple[int | None, ...]]] = {
    "uv": (np.float32, (None, 2)),
    "material_textures": (np.int32, (None, len(TEXTURED))),
    "normal_textures": (np.int32, (None,)),
}
"""dtype and shape of the array fields that only textured scenes have."""

_DIFFUSE, _SPECULAR = (TEXTURED.index(name) for name in ("diffuse", "specular"))
_BLOCK = 256  # rows of a texture that are compared at a time


def has_maps(scene: "Scene") -> bool:
    """Return whether a scene has anything of schema 4."""
    has_arrays = any(getattr(scene, name) is not None for name in MAP_ARRAYS)
    return bool(scene.textures) or scene.environment is not None or has_arrays


def check_maps(scene: "Scene") -> None:
    """Raise TrilightError at the first broken law of textures and environment."""
    held = [texture.texels.nbytes for texture in scene.textures]
    if scene.environment is not None:
        held.append(scene.environment.radiance_rgb.nbytes)
    if sum(held) > MAX_MAPS_BYTES:
        broken_law(f"textures and environment take {sum(held)} bytes", f"at most {MAX_MAPS_BYTES}")
    if scene.environment is not None:
        scene.environment.check()
    together = (scene.uv is not None, scene.material_textures is not None, bool(scene.textures))
    if any(together) and not all(together):
        missing = ("uv", "material_textures", "textures")[together.index(False)]
        broken_law(f"{missing} is missing", "uv, material_textures and textures, or none of them")
    if scene.normal_textures is not None and not scene.textures:
        broken_law("normal_textures is there without textures", "both, or no normal_textures")
    if scene.textures:
        for name, (dtype, (_, *widths)) in MAP_ARRAYS.items():
            length = 3 * scene.num_triangles if name == "uv" else len(scene.materials)
            if (array := getattr(scene, name)) is not None:
                require_array(array, name, dtype, (length, *widths))
        _check_textures(scene)
        for row, diffuse, specular in _albedos(scene):
            _check_sum(row, diffuse, specular)


def _check_textures(scene: "Scene") -> None:
    count = len(scene.textures)
    seen = set[str]()
    for row, texture in enumerate(scene.textures):
        texture.check(f"textures[{row}]")
        if texture.sha256 in seen:
            broken_law(f"textures[{row}] has the content of another", "each content once")
        seen.add(texture.sha256)
    index = scene.material_textures
    assert index is not None
    normals = np.zeros(0, np.int32) if scene.normal_textures is None else scene.normal_textures
    for name, rows in (("material_textures", index), ("normal_textures", normals)):
        lawful = (rows >= CONSTANT) & (rows < count)
        require_law(lawful, name, rows, f"rows below {count}, or {CONSTANT} for none")
    unused = np.setdiff1d(np.arange(count), np.append(index, normals))
    if len(unused):
        broken_law(f"textures[{unused[0]}] is used by no material", "textures that are used")
    widths = {column.name: column.width for column, _ in laid_out()}
    for place, name in enumerate(TEXTURED):
        for row in np.unique(index[:, place][index[:, place] != CONSTANT]):
            if (got := scene.textures[row].channels) != widths[name]:
                broken_law(f"textures[{row}] has {got} channels", f"{widths[name]}, as {name} has")
    for row in np.unique(normals[normals != CONSTANT]):
        texture = scene.textures[row]
        if texture.channels != 3 or texture.is_srgb:
            got = f"{texture.channels} channels{', sRGB-encoded' if texture.is_srgb else ''}"
            broken_law(f"textures[{row}] has {got}", "3 linear channels, as a normal map has")


Reflecting = Texture | NDArray[np.float32]
"""An albedo: its texture, or the constant [3]."""


def _albedos(scene: "Scene") -> Iterator[tuple[int, Reflecting, Reflecting]]:
    """Yield the diffuse and the specular albedo of the material rows in which one is textured."""
    assert scene.material_textures is not None
    places = column_places()
    index = scene.material_textures[:, [_DIFFUSE, _SPECULAR]]
    for row in np.flatnonzero((index != CONSTANT).any(axis=1)):
        diffuse, specular = (
            scene.materials[row, places[TEXTURED[place]]]
            if scene.material_textures[row, place] == CONSTANT
            else scene.textures[scene.material_textures[row, place]]
            for place in (_DIFFUSE, _SPECULAR)
        )
        yield int(row), diffuse, specular


def _check_sum(row: int, diffuse: Reflecting, specular: Reflecting) -> None:
    """Raise TrilightError where albedos add up to more than 1 at any texture coordinate."""
    albedo_sum = _greatest(diffuse) + _greatest(specular)
    bound = 1 + SUM_TOLERANCE
    if (albedo_sum <= bound).all():
        return  # whatever meets what
    if isinstance(diffuse, Texture) and isinstance(specular, Texture):
        albedo_sum = _greatest_sum(diffuse, specular)
    name = f"materials[{row}] with its textures: diffuse + specular"
    require_law(albedo_sum <= bound, name, albedo_sum, "at most 1 at every texture coordinate")


def _greatest(albedo: Reflecting) -> NDArray[np.float32]:
    return albedo.greatest if isinstance(albedo, Texture) else albedo


def _greatest_sum(one: Texture, other: Texture) -> NDArray[np.float64]:
    """Return the greatest sum [3] of two textures over all texture coordinates.

    Between the centres of texels of either one, the sum is bilinear, and has its extremes at the
    corners of such a cell: where a centre's u of one or the other meets a centre's v.
    """
    u, v = (
        np.union1d(*((np.arange(side) + 0.5) / side for side in sides))
        for sides in (
            (one.texels.shape[1], other.texels.shape[1]),
            (one.texels.shape[0], other.texels.shape[0]),
        )
    )
    greatest = np.zeros(3)
    for first in range(0, len(v), _BLOCK):
        uv = np.stack(np.meshgrid(u, v[first : first + _BLOCK]), axis=-1)
        total = texture_values(one, uv) + texture_values(other, uv)
        greatest = np.maximum(greatest, total.max(axis=(0, 1)))
    return greatest
