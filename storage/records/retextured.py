"""Scenes with other textures: without constant ones, without any, or of other triangles."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from storage.records.lookup import FLAT
from storage.records.material import column_places
from storage.records.texture import CONSTANT, TEXTURED, Texture

if TYPE_CHECKING:
    from storage.records.scene import Scene

NO_TEXTURES: Mapping[str, Any] = {
    "uv": None,
    "textures": (),
    "material_textures": None,
    "normal_textures": None,
}
"""Fields of a scene without textures."""

NEW = -1
"""In `chosen_maps`: a triangle or a material that the scene does not have."""

AnyScene = TypeVar("AnyScene", bound="Scene")


def without_constant_textures(scene: AnyScene) -> AnyScene:
    """Return the same scene with every texture of one colour as the constant that it is.

    Textures that are then used by no material go, and the texture coordinates with the last one: a
    scene of constant textures has the bytes of the scene without them.
    """
    constants = {
        row: texture.constant
        for row, texture in enumerate(scene.textures)
        if texture.constant is not None
    }
    if not constants or scene.material_textures is None:
        return scene
    materials = scene.materials.copy()
    index = scene.material_textures.copy()
    places = column_places()
    normals = scene.normal_textures
    if normals is not None:
        flat = [row for row, value in constants.items() if np.array_equal(value, FLAT)]
        normals = np.where(np.isin(normals, flat), np.int32(CONSTANT), normals)
    for place, name in enumerate(TEXTURED):
        for row, value in constants.items():
            chosen = np.flatnonzero(index[:, place] == row)
            if len(chosen):  # else it is one of another width
                materials[chosen, places[name]] = value
                index[chosen, place] = CONSTANT
    return dataclasses.replace(
        scene, materials=materials, **_used_maps(scene.uv, scene.textures, index, normals)
    )


def with_textures(
    scene: AnyScene,
    uv: NDArray[np.float32],
    textures: tuple[Texture, ...],
    material_textures: NDArray[np.int32],
    normal_textures: NDArray[np.int32] | None = None,
) -> AnyScene:
    """Return the same scene with textures, whose columns hold their means; its own ones go.

    Each corner of each triangle has its `uv` [3T, 2]. Each texture is used, and each content is
    there once. `material_textures` [M, 3], in the order of TEXTURED, and `normal_textures` [M] are
    rows of `textures`, or CONSTANT.
    """
    return dataclasses.replace(
        scene,
        materials=_with_means(scene.materials, textures, material_textures),
        uv=uv,
        textures=textures,
        material_textures=material_textures,
        normal_textures=normal_textures,
    )


def chosen_maps(
    scene: "Scene", triangles: NDArray[np.integer], materials: NDArray[np.integer]
) -> dict[str, Any]:
    """Return the fields that textures take in a scene of other triangles and materials.

    Args:
        scene: what they are taken from.
        triangles: [T] rows of its triangles, or NEW.
        materials: [M] rows of its materials, or NEW for one that has no textures.
    """
    if scene.uv is None or scene.material_textures is None:
        return {}
    corners = np.append(scene.uv.reshape(-1, 3, 2), np.zeros((1, 3, 2), np.float32), axis=0)
    plain = np.full((1, len(TEXTURED)), CONSTANT, np.int32)
    index = np.append(scene.material_textures, plain, axis=0)[materials]
    normals = scene.normal_textures
    if normals is not None:
        normals = np.append(normals, np.int32(CONSTANT))[materials]
    return _used_maps(corners[triangles].reshape(-1, 2), scene.textures, index, normals)


def without_normal_maps(scene: AnyScene) -> AnyScene:
    """Return the same scene without normal maps, and without textures that were nothing else."""
    if scene.normal_textures is None or scene.material_textures is None:
        return scene
    return dataclasses.replace(
        scene, **_used_maps(scene.uv, scene.textures, scene.material_textures, None)
    )


def _used_maps(
    uv: NDArray[np.float32] | None,
    textures: tuple[Texture, ...],
    index: NDArray[np.int32],
    normals: NDArray[np.int32] | None,
) -> dict[str, Any]:
    """Return the fields of coordinates, textures and their rows without textures that none uses."""
    if normals is not None and (normals == CONSTANT).all():
        normals = None
    used_rows = np.setdiff1d(index if normals is None else np.append(index, normals), CONSTANT)
    if not len(used_rows):
        return dict(NO_TEXTURES)
    renumbered = np.full(len(textures) + 1, CONSTANT, np.int32)  # the last one is that of CONSTANT
    renumbered[used_rows] = np.arange(len(used_rows))
    return {
        "uv": uv,
        "textures": tuple(textures[row] for row in used_rows),
        "material_textures": renumbered[index],
        "normal_textures": None if normals is None else renumbered[normals],
    }


def _with_means(
    materials: NDArray[np.float32],
    textures: tuple[Texture, ...],
    material_textures: NDArray[np.int32],
) -> NDArray[np.float32]:
    rows = materials.copy()
    places = column_places()
    for place, name in enumerate(TEXTURED):
        for row in np.flatnonzero(material_textures[:, place] != CONSTANT):
            rows[row, places[name]] = textures[material_textures[row, place]].mean
    return rows


def without_maps(scene: AnyScene, *, textures: bool = True, environment: bool = True) -> AnyScene:
    """Return the same scene without its textures, or its environment, or both.

    In the place of a texture stands its mean.
    """
    if environment:
        scene = dataclasses.replace(scene, environment=None)
    if not textures or scene.material_textures is None:
        return scene
    materials = _with_means(scene.materials, scene.textures, scene.material_textures)
    return dataclasses.replace(scene, materials=materials, **NO_TEXTURES)
