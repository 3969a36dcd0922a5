"""Reads USD files: scenes of Trilight bit for bit, others as far as a `Scene` can hold them.

A scene that Trilight wrote is read from its layer, without composing a stage. After an edit (a mesh
moved, a color changed, a light added) the exact attributes of a file are stale. So the scene is
compared with its digest, and the file with what export writes of it. Where anything differs, the
file is read as a foreign one (pipeline.exchange.usd.foreign_scene). The
errors of `_NOT_AS_WRITTEN` mean that a layer is not as export writes it.

Only child processes with limits import this (pipeline.isolation): native code parses the file.
"""

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES
from pipeline.exchange.textured_triangles import MAX_ROWS, LoadedScene
from pipeline.exchange.usd import prim_names as names
from pipeline.exchange.usd.foreign_scene import build_stage_scene
from pipeline.exchange.usd.write_materials import (
    PREVIEW,
    PREVIEW_INPUTS,
    SHADERS,
    ST,
    decode_texture,
)
from pipeline.exchange.usd.write_usd import (
    CENTER,
    ENVIRONMENT,
    author_scene,
    new_layer,
    sum_positions,
)
from pipeline.foreign.usd.stage import OpenedStage, read_quietly
from pipeline.foreign.usd.texture_nodes import asset_bytes
from storage.conventions import require_readable
from storage.errors import Rejected, TrilightError
from storage.records.environment import Environment
from storage.records.exr import decode_exr
from storage.records.material import (
    PUBLISHED_COLUMNS,
    UndeclaredColumn,
    declared_column,
    default_rows,
    laid_out,
)
from storage.records.scene import OBJECT_KINDS, Scene, SceneObject
from storage.records.scene_file import scene_digest, scene_provenance
from storage.records.texture import CONSTANT, NORMAL, TEXTURED, MapSource, Texture

MAX_FRAMES = 10_000
"""Maximum number of scenes in a stage with time samples."""


def usd_keys(path: Path, folder: Path | None = None) -> list[str]:
    """Return the keys of the scenes of a file; one empty key for a single scene.

    Raises:
        TrilightError: the file is unusable (pipeline.foreign.usd.stage).
    """
    return read_quietly(path, lambda: _keys(OpenedStage(path, folder)))


def read_usd(path: Path, key: str | None, folder: Path | None, licence: str) -> LoadedScene:
    """Return one scene of a file.

    Args:
        path: the file.
        key: key in a shard, or time code; the first scene by default.
        folder: folder whose files may be read; that of `path` by default.
        licence: licence of objects that state none.

    Raises:
        TrilightError: the file is unusable, lacks the scene, or a `Scene` cannot hold it.
    """
    return read_quietly(path, lambda: _read(path, key, folder, licence))


def _read(path: Path, key: str | None, folder: Path | None, licence: str) -> LoadedScene:
    from pxr import Usd

    opened = OpenedStage(path, folder)
    shard = _scene_keys(opened.root)
    if shard is not None:
        return _read_shard_scene(opened, shard, key or shard[0])
    if key is None:
        scene = _read_exact(opened)
        if scene is not None:
            return LoadedScene(scene=scene, notes=())
    stage = opened.compose()
    frames = list(_frames(stage))
    if _is_marked(opened.root):
        opened.lost.append("changed since Trilight wrote it: read as any other file")
    if key is not None and key not in frames:
        expected = f"{frames[0]} to {frames[-1]}" if frames else "none: it does not move"
        raise TrilightError(f"{path.name}: no time code {key}; expected one of {expected}.")
    chosen = key or (frames[0] if frames else "")
    if frames and key is None:
        opened.lost.append(f"time codes other than {chosen} of {len(frames)}")
    time = Usd.TimeCode(float(chosen)) if chosen else Usd.TimeCode.EarliestTime()
    try:
        scene = build_stage_scene(stage, time, opened, licence, _read_written_rows(opened))
    except (TrilightError, Rejected) as error:
        message = error.message if isinstance(error, Rejected) else str(error)
        text = message.removeprefix(f"{path.name}: ")
        raise TrilightError(f"{path.name}: {text}") from error
    return LoadedScene(scene=scene, notes=opened.notes)


def _read_shard_scene(opened: OpenedStage, keys: list[str], key: str) -> LoadedScene:
    name = opened.path.name
    if key not in keys:
        raise TrilightError(f"{name}: no scene {key}; expected one of {keys[0]} to {keys[-1]}.")
    scene = _read_exact(opened, key)
    if scene is None:
        raise TrilightError(
            f"{name}: scene {key} has been changed since Trilight wrote it; save it as a file of "
            "its own and read that."
        )
    return LoadedScene(scene=scene, notes=())


def _keys(opened: OpenedStage) -> list[str]:
    shard = _scene_keys(opened.root)
    if shard is not None:
        return shard
    if _read_exact(opened) is not None:
        return [""]
    return list(_frames(opened.compose())) or [""]


def _frames(stage: Any) -> Iterator[str]:
    """Yield the time codes of an animated stage: its frames, or else its samples."""
    if len({t for layer in stage.GetUsedLayers() for t in layer.ListAllTimeSamples()}) < 2:
        return
    if not stage.HasAuthoredTimeCodeRange():
        times = np.unique(list(_list_samples(stage)))
    else:
        first = stage.GetStartTimeCode()
        last = stage.GetEndTimeCode()
        if not last - first < MAX_FRAMES:  # also refuses NaN
            raise TrilightError(
                f"time codes from {first:g} to {last:g}; expected at most {MAX_FRAMES}."
            )
        times = np.arange(first, last + 1)
    if len(times) > MAX_FRAMES:
        raise TrilightError(f"{len(times)} time codes; expected at most {MAX_FRAMES}.")
    for time in times:
        yield f"{time:g}"


def _list_samples(stage: Any) -> Iterator[float]:
    """Yield the time codes of all samples, in the time of the stage."""
    from pxr import Usd

    for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange.AllPrims(root):
            for attribute in prim.GetAuthoredAttributes():
                yield from attribute.GetTimeSamples()


def _scene_keys(layer: Any) -> list[str] | None:
    """Return the keys of the scenes of a shard that Trilight wrote; None for any other layer."""
    root = layer.GetPrimAtPath(names.SHARD_ROOT)
    if layer.defaultPrim != names.SHARD_ROOT.removeprefix("/") or root is None:
        return None
    if names.VARIANT_SET not in root.variantSets or len(root.nameChildren):
        return None
    keys: list[str] = list(root.variantSets[names.VARIANT_SET].variants.keys())
    all_marked = all(_find_root(layer, key) is not None for key in keys)
    return keys if all_marked and keys else None


def _is_marked(layer: Any) -> bool:
    """Return whether a layer has the marks of a scene that Trilight wrote."""
    return _find_root(layer, None) is not None


def _read_exact(opened: OpenedStage, key: str | None = None) -> Scene | None:
    """Read the scene of a file, or of a key of a shard; return None where it was changed.

    Raises:
        TrilightError: the file has an unsupported version or an undeclared material column, or the
            scene breaks a law (`Scene.check`).
    """
    layer = opened.root
    root = _find_root(layer, key)
    if root is None or len(layer.subLayerPaths) or len(layer.rootPrims) != 1:
        return None
    name = layer.GetDisplayName()
    require_readable(root.attributes[names.VERSION].default, name)
    try:
        scene = _read_scene(root, opened)
    except UndeclaredColumn as error:
        raise TrilightError(f"{name}: {error}") from error
    except _NOT_AS_WRITTEN:
        return None
    if scene_digest(scene) != root.attributes[names.DIGEST].default:
        return None
    try:
        scene.check()
    except TrilightError as error:
        raise TrilightError(f"{name}: {error}") from error
    expected = new_layer(".usdc", names.ROOT)
    try:
        written = author_scene(expected, names.ROOT, scene)
        _require_same(root, written, (_plain_path(root), _plain_path(written)))
    except _NOT_AS_WRITTEN:
        return None
    return scene


def _read_written_rows(opened: OpenedStage) -> dict[str, NDArray[np.float32]]:
    """Return the material rows that Trilight wrote, by the paths of their prims; else none.

    The digest of the scene tells whether the attributes still are what was written, or the preview
    shaders. It cannot where the meshes were changed too.
    """
    root = _find_root(opened.root, None)
    if root is None:
        return {}
    try:
        scene = _read_scene(root, opened)
        prims = _list_by_row(root.nameChildren["Materials"], names.material_name)
        of_preview = scene.materials.copy()
        for row, prim in enumerate(prims):
            inputs = prim.nameChildren[PREVIEW].attributes
            for column, part in laid_out():
                if column.name in PREVIEW_INPUTS:
                    of_preview[row, part] = inputs[f"inputs:{PREVIEW_INPUTS[column.name]}"].default
        for rows in (scene.materials, of_preview):
            digest = scene_digest(dataclasses.replace(scene, materials=rows))
            if digest == root.attributes[names.DIGEST].default:
                return {str(prim.path): rows[row] for row, prim in enumerate(prims)}
    except (UndeclaredColumn, *_NOT_AS_WRITTEN):
        pass
    return {}


def _find_root(layer: Any, key: str | None) -> Any:
    path = names.ROOT
    if key is not None:
        path = f"{names.SHARD_ROOT}{{{names.VARIANT_SET}={key}}}{path.removeprefix('/')}"
    root = layer.GetPrimAtPath(path)
    marks = (names.VERSION, names.DIGEST)
    return root if root and all(mark in root.attributes for mark in marks) else None


def _read_scene(root: Any, opened: OpenedStage) -> Scene:
    folders = root.nameChildren
    sky = None
    if ENVIRONMENT in folders:
        sky = _read_dome(folders[ENVIRONMENT], root.layer, opened)
    materials = _read_materials(folders["Materials"], opened)
    prims = sorted(folders["Objects"].nameChildren, key=lambda p: p.attributes[names.INDEX].default)
    objects = tuple(_read_object(prim) for prim in prims)
    meshes = [prim for prim in prims if prim.typeName == "Mesh"]
    vertices, normals = _read_vertices(root, meshes)
    faces, material_index, object_index = _read_faces(meshes)
    c2w, fov_deg = _read_cameras(folders["Cameras"])
    return Scene(
        vertex_positions=vertices,
        vertex_normals=normals,
        faces=faces,
        material_index=material_index,
        object_index=object_index,
        c2w=c2w,
        fov_deg=fov_deg,
        objects=objects,
        provenance=scene_provenance(json.loads(root.attributes[names.PROVENANCE].default)),
        uv=_read_coordinates(meshes, len(faces)) if materials["textures"] else None,
        **materials,
        environment=sky,
    )


def _read_dome(prim: Any, layer: Any, opened: OpenedStage) -> Environment:
    """Read the environment that was written; raises LookupError without its file."""
    data = _read_asset(layer, opened, prim.attributes[names.MAP_PATH].default.path)
    matrix = np.array(prim.attributes["xformOp:transform"].default).T
    texts = {field: prim.attributes[name].default for field, name in names.MAP_TEXTS.items()}
    return Environment(
        radiance_rgb=decode_exr(data),
        rotation=(matrix[:3, :3] @ names.TO_OUR_AXES.T).astype(np.float32),
        is_seen=bool(prim.attributes[names.VISIBLE_TO_CAMERA].default),
        source=MapSource(**texts),
    )


def _read_object(prim: Any) -> SceneObject:
    texts = {field: prim.attributes[name].default for field, name in names.OBJECT_TEXTS.items()}
    _require(texts["kind"] in OBJECT_KINDS)
    return SceneObject(**texts)


def _read_vertices(root: Any, meshes: list[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return positions and normals [V, 3], placed by the vertex rows of meshes and root."""
    kinds = [(root, names.UNUSED_ROWS, names.UNUSED_NORMALS)]
    kinds += [(mesh, names.VERTEX_ROWS, "normals") for mesh in meshes]
    rows = np.concatenate([_read_integers(prim, name) for prim, name, _ in kinds])
    _require(len(rows) > 0 and rows.min() >= 0)
    count = int(rows.max()) + 1
    _require(count <= len(rows) and len(np.unique(rows)) == count)
    positions = np.zeros((count, 3), np.float32)
    normals = np.zeros((count, 3), np.float32)
    unused = _read_vectors(root, names.UNUSED_POSITIONS)
    positions[rows] = np.concatenate([unused, *(_read_positions(mesh) for mesh in meshes)])
    normals[rows] = np.concatenate([_read_vectors(prim, name) for prim, _, name in kinds])
    return positions, normals


def _read_positions(mesh: Any) -> NDArray[np.float32]:
    """Return the positions [V, 3] of a mesh's vertices."""
    name = _OLD_CENTER if _OLD_CENTER in mesh.attributes else CENTER
    center = np.array(mesh.attributes[name].default, np.float64)
    positions = sum_positions(center, _read_vectors(mesh, "points"))
    positions[_read_integers(mesh, names.EXACT_ROWS)] = _read_vectors(mesh, names.EXACT_POSITIONS)
    return positions


def _read_faces(
    meshes: list[Any],
) -> tuple[NDArray[np.uint32], NDArray[np.uint16], NDArray[np.uint16]]:
    rows = np.concatenate([_read_integers(mesh, names.FACE_ROWS) for mesh in meshes])
    count = len(rows)
    _require(np.array_equal(np.sort(rows), np.arange(count)))
    faces = np.zeros((count, 3), np.uint32)
    material_index = np.zeros(count, np.uint16)
    object_index = np.zeros(count, np.uint16)
    for mesh in meshes:
        face_rows = _read_integers(mesh, names.FACE_ROWS)
        vertex_rows = _read_integers(mesh, names.VERTEX_ROWS)
        faces[face_rows] = vertex_rows[_read_integers(mesh, "faceVertexIndices").reshape(-1, 3)]
        object_index[face_rows] = mesh.attributes[names.INDEX].default
        index = np.full(len(face_rows), -1)
        for subset in mesh.nameChildren:
            index[_read_integers(subset, "indices")] = int(subset.name.rpartition("_")[2])
        _require(len(index) > 0 and index.min() >= 0 and index.max() < MAX_ROWS)
        material_index[face_rows] = index
    return faces, material_index, object_index


def _read_coordinates(meshes: list[Any], count: int) -> NDArray[np.float32]:
    """Return the texture coordinates [3T, 2] of all corners."""
    uv = np.zeros((count, 3, 2), np.float32)
    for mesh in meshes:
        corner_uv = np.array(mesh.attributes[ST].default, np.float32)
        uv[_read_integers(mesh, names.FACE_ROWS)] = corner_uv.reshape(-1, 3, 2)
    return uv.reshape(-1, 2)


def _read_cameras(folder: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    prims = _list_by_row(folder, names.camera_name)
    c2w = np.zeros((len(prims), 4, 4), np.float32)
    fov_deg = np.zeros(len(prims), np.float32)
    for row, prim in enumerate(prims):
        c2w[row] = np.array(prim.attributes["xformOp:transform"].default).T
        fov_deg[row] = prim.attributes[names.FOV_DEG].default
    return c2w, fov_deg


def _read_materials(folder: Any, opened: OpenedStage) -> dict[str, Any]:
    """Return the fields of a scene on materials and textures; raises UndeclaredColumn."""
    prims = _list_by_row(folder, names.material_name)
    rows = default_rows(len(prims))
    columns = _list_columns(prims[0])
    places = (*TEXTURED, NORMAL)
    index = np.full((len(prims), len(places)), CONSTANT, np.int32)
    textures: dict[int, Texture] = {}
    for row, prim in enumerate(prims):
        for column, part in laid_out():
            if column.name in columns:
                rows[row, part] = prim.attributes[names.column_attribute(column.name)].default
        for name, texture in _read_textures(prim, textures, opened).items():
            index[row, places.index(name)] = texture
    normals = index[:, len(TEXTURED)].copy()
    return {
        "materials": rows,
        "textures": tuple(textures[row] for row in range(len(textures))),
        "material_textures": index[:, : len(TEXTURED)].copy() if textures else None,
        "normal_textures": normals if (normals != CONSTANT).any() else None,
    }


def _read_textures(prim: Any, textures: dict[int, Texture], opened: OpenedStage) -> dict[str, int]:
    """Return the texture rows of a material's columns, and add new ones to `textures`."""
    used = {}
    for name, shader in SHADERS.items():
        if shader not in prim.nameChildren:
            continue
        attributes = prim.nameChildren[shader].attributes
        row = attributes[names.TEXTURE_ROW].default
        if row not in textures:
            textures[row] = _read_texture(attributes, prim.layer, opened)
        used[name] = row
    return used


def _read_texture(attributes: Any, layer: Any, opened: OpenedStage) -> Texture:
    named = attributes["inputs:file"].default.path
    texts = {field: attributes[name].default for field, name in names.MAP_TEXTS.items()}
    return decode_texture(
        _read_asset(layer, opened, named),
        is_exr=named.endswith(".exr"),
        is_srgb=attributes["inputs:sourceColorSpace"].default == "sRGB",
        source=MapSource(**texts),
    )


def _read_asset(layer: Any, opened: OpenedStage, path: str) -> bytes:
    resolved = opened.resolve(layer, path)
    data = None if resolved is None else asset_bytes(resolved, MAX_BYTES)
    if data is None:
        raise LookupError(path)
    return data


def _list_columns(prim: Any) -> tuple[str, ...]:
    """Return the column names of a material; raises UndeclaredColumn."""
    added_or_none = (names.added_column(attribute.name) for attribute in prim.attributes)
    added = [name for name in added_or_none if name is not None]
    return (*PUBLISHED_COLUMNS, *(declared_column(name).name for name in added))


_NOT_AS_WRITTEN = (LookupError, TypeError, ValueError, AttributeError)
"""Errors of a layer that is not as export writes it."""
_PLAIN_INFO = {"specifier", "typeName", "apiSchemas", "documentation", "comment", "displayName"}
"""Metadata that does not change how a prim looks."""
_OLD_CENTER = "xformOp:translate:center"
"""Name of the transform to the center in older files, such as `examples/room.usdz`."""


def _require_same(stored: Any, expected: Any, roots: tuple[str, str]) -> None:
    """Require that a prim and all below it, at two root paths, are as export writes them."""
    _require(stored.typeName == expected.typeName and set(stored.ListInfoKeys()) <= _PLAIN_INFO)
    properties = {each.name: each for each in stored.properties}
    if _OLD_CENTER in properties:
        expected.attributes[CENTER].name = _OLD_CENTER
        expected.attributes["xformOpOrder"].default = (_OLD_CENTER,)
    _require(properties.keys() == {each.name for each in expected.properties})
    for each in expected.properties:
        _require_same_property(properties[each.name], each, roots)
    prims = {prim.name: prim for prim in stored.nameChildren}
    _require(prims.keys() == {prim.name for prim in expected.nameChildren})
    for prim in expected.nameChildren:
        _require_same(prims[prim.name], prim, roots)


def _require_same_property(stored: Any, expected: Any, roots: tuple[str, str]) -> None:
    _require(type(stored) is type(expected))
    links = "targetPathList"
    if hasattr(expected, "connectionPathList"):
        links = "connectionPathList"
        _require(stored.typeName == expected.typeName and stored.default == expected.default)
        _require(not stored.HasInfo("timeSamples"))
        _require(stored.GetInfo("interpolation") == expected.GetInfo("interpolation"))
        if not (stored.HasInfo("connectionPaths") or expected.HasInfo("connectionPaths")):
            return
    paths, expected_paths = (
        [str(path).removeprefix(root) for path in getattr(each, links).explicitItems]
        for each, root in zip((stored, expected), roots, strict=True)
    )
    _require(paths == expected_paths)


def _plain_path(prim: Any) -> str:
    return str(prim.path.StripAllVariantSelections())


def _list_by_row(folder: Any, name: Callable[[int], str]) -> list[Any]:
    """Return the children of a prim in the order of their rows; look-ups by name are quadratic."""
    prims = {prim.name: prim for prim in folder.nameChildren}
    return [prims[name(row)] for row in range(len(prims))]


def _read_integers(prim: Any, name: str) -> NDArray[np.int64]:
    values = np.array(prim.attributes[name].default, np.int64)
    _require(values.ndim == 1)
    return values


def _read_vectors(prim: Any, name: str) -> NDArray[np.float32]:
    return np.array(prim.attributes[name].default, np.float32).reshape(-1, 3)


def _require(condition: Any) -> None:
    if not condition:
        raise ValueError("the layer is not as export wrote it")
