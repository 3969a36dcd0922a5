"""Reads USD files: scenes of Trilight bit for bit, others as far as a `Scene` can hold them.

A scene that Trilight wrote is read from its layer, without composing a stage. After an edit (a mesh
moved, a color changed, a light added) the exact attributes of a file are stale. So the scene is
compared with its digest, and the file with what export writes of it. Where anything differs, the
file is read as a foreign one (pipeline.exchange.usd.foreign_scene). The
errors of `_NOT_AS_WRITTEN` mean that a layer is not as export writes it.

Only child processes with limits import this (pipeline.isolation): native code parses the file.
"""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Usd

from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.exchange.usd import layout
from pipeline.exchange.usd.foreign_scene import StageReader
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
from pipeline.foreign.picture import MAX_BYTES
from pipeline.foreign.usd.stage import OpenedStage, read_quietly
from pipeline.foreign.usd.texture_nodes import asset_bytes
from storage.conventions import require_readable
from storage.errors import Rejected, TrilightError
from storage.records.exr import decode_exr
from storage.records.material import (
    PUBLISHED_COLUMNS,
    UndeclaredColumn,
    column_places,
    declared_column,
    default_rows,
    laid_out,
)
from storage.records.scene import OBJECT_KINDS, Scene, SceneObject
from storage.records.scene_file import scene_digest, scene_provenance
from storage.records.texture import CONSTANT, TEXTURED, Environment, MapSource, Texture

MAX_FRAMES = 10_000
"""Maximum number of scenes in a stage with time samples."""


def usd_keys(path: Path, folder: Path | None = None) -> list[str]:
    """Return the keys of the scenes of a file; one empty key for a single scene.

    Raises:
        TrilightError: the file is unusable (pipeline.foreign.usd.stage).
    """
    with _open(path, folder) as opened:
        shard = _scene_keys(opened.root)
        if shard is not None:
            return shard
        if _read_exact(opened) is not None:
            return [""]
        return list(_frames(opened.compose())) or [""]


def read_usd(path: Path, key: str | None = None, folder: Path | None = None) -> LoadedScene:
    """Return one scene of a file.

    Args:
        path: the file.
        key: key in a shard, or time code; the first scene by default.
        folder: folder whose files may be read; that of `path` by default.

    Raises:
        TrilightError: the file is unusable, lacks the scene, or a `Scene` cannot hold it.
    """
    with _open(path, folder) as opened:
        shard = _scene_keys(opened.root)
        if shard is not None:
            return LoadedScene(scene=_read_shard_scene(opened, shard, key or shard[0]), notes=())
        if key is None and (scene := _read_exact(opened)) is not None:
            return LoadedScene(scene=scene, notes=())
        return _read_foreign(opened, key)


@contextlib.contextmanager
def _open(path: Path, folder: Path | None) -> Iterator[OpenedStage]:
    """Yield an opened file; begin every message on it with its name."""
    try:
        with read_quietly(path):
            yield OpenedStage(path, folder)
    except (TrilightError, Rejected) as error:
        message = error.message if isinstance(error, Rejected) else str(error)
        if isinstance(error, TrilightError) and message.startswith(path.name):
            raise
        text = message.removeprefix(f"{path.name}: ")
        raise TrilightError(f"{path.name}: {text}") from error


def _read_foreign(opened: OpenedStage, key: str | None) -> LoadedScene:
    """Read a stage as any other file, at a time code or the first one."""
    stage = opened.compose()
    frames = list(_frames(stage))
    if _find_root(opened.root, None) is not None:
        opened.lost.append("changed since Trilight wrote it: read as any other file")
    if key is not None and key not in frames:
        expected = f"{frames[0]} to {frames[-1]}" if frames else "none: it does not move"
        raise TrilightError(f"no time code {key}; expected one of {expected}.")
    chosen = key or (frames[0] if frames else "")
    if frames and key is None:
        opened.lost.append(f"time codes other than {chosen} of {len(frames)}")
    if chosen:
        opened.time = Usd.TimeCode(float(chosen))
    scene = StageReader(stage, opened, _read_written_columns(opened)).scene()
    return LoadedScene(scene=scene, notes=opened.notes)


def _read_shard_scene(opened: OpenedStage, keys: list[str], key: str) -> Scene:
    if key not in keys:
        raise TrilightError(f"no scene {key}; expected one of {keys[0]} to {keys[-1]}.")
    scene = _read_exact(opened, key)
    if scene is None:
        raise TrilightError(
            f"scene {key} has been changed since Trilight wrote it; save it as a file of its own "
            "and read that."
        )
    return scene


def _frames(stage: Any) -> Iterator[str]:
    """Yield the time codes of an animated stage: its frames, or else its samples."""
    if len({t for layer in stage.GetUsedLayers() for t in layer.ListAllTimeSamples()}) < 2:
        return
    if not stage.HasAuthoredTimeCodeRange():
        roots = (stage.GetPseudoRoot(), *stage.GetPrototypes())
        prims = (prim for root in roots for prim in Usd.PrimRange.AllPrims(root))
        attributes = [each for prim in prims for each in prim.GetAuthoredAttributes()]
        times = np.array(Usd.Attribute.GetUnionedTimeSamples(attributes))  # in those of the stage
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


def _scene_keys(layer: Any) -> list[str] | None:
    """Return the keys of the scenes of a shard that Trilight wrote; None for any other layer."""
    root = layer.GetPrimAtPath(layout.SHARD_ROOT)
    if layer.defaultPrim != layout.SHARD_ROOT.removeprefix("/") or root is None:
        return None
    if layout.VARIANT_SET not in root.variantSets or len(root.nameChildren):
        return None
    keys: list[str] = list(root.variantSets[layout.VARIANT_SET].variants.keys())
    all_marked = all(_find_root(layer, key) is not None for key in keys)
    return keys if all_marked and keys else None


def _read_exact(opened: OpenedStage, key: str | None = None) -> Scene | None:
    """Read the scene of a file, or of a key of a shard; return None where it was changed.

    Raises:
        TrilightError: the file has an unsupported version or an undeclared material column, or the
            scene breaks a law (`Scene.check`).
    """
    root = _find_root(opened.root, key)
    if root is None or len(opened.root.subLayerPaths) or len(opened.root.rootPrims) != 1:
        return None
    require_readable(root.attributes[layout.VERSION].default, opened.path.name)
    try:
        scene = _read_scene(root, opened)
        if scene_digest(scene) != root.attributes[layout.DIGEST].default:
            return None
        layer = new_layer(layout.ROOT)  # specs end with the last name of their layer
        written = author_scene(layer, str(root.path), scene)
        if _list_specs(root) != _list_specs(written):
            return None
    except UndeclaredColumn:
        raise
    except _NOT_AS_WRITTEN:
        return None
    scene.check()
    return scene


def _read_written_columns(opened: OpenedStage) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Return the columns that Trilight wrote, by the paths of materials; else none.

    The digest of the scene tells whether the attributes still are what was written, or the preview
    shaders. It cannot where the meshes were changed too.
    """
    root = _find_root(opened.root, None)
    if root is None:
        return {}
    with contextlib.suppress(UndeclaredColumn, *_NOT_AS_WRITTEN):
        scene = _read_scene(root, opened)
        prims = _list_by_row(root.nameChildren["Materials"], layout.material_name)
        of_preview = scene.materials.copy()
        places = column_places()
        for row, prim in enumerate(prims):
            inputs = prim.nameChildren[PREVIEW].attributes
            for column, name in PREVIEW_INPUTS.items():
                of_preview[row, places[column]] = inputs[f"inputs:{name}"].default
        for rows in (scene.materials, of_preview):
            digest = scene_digest(dataclasses.replace(scene, materials=rows))
            if digest == root.attributes[layout.DIGEST].default:
                return {
                    str(prim.path): {name: rows[row, part] for name, part in places.items()}
                    for row, prim in enumerate(prims)
                }
    return {}


def _find_root(layer: Any, key: str | None) -> Any:
    """Return the prim of a scene, or of a key of a shard, with Trilight's marks; else None."""
    path = layout.ROOT
    if key is not None:
        path = f"{layout.SHARD_ROOT}{{{layout.VARIANT_SET}={key}}}{path.removeprefix('/')}"
    root = layer.GetPrimAtPath(path)
    marks = (layout.VERSION, layout.DIGEST)
    return root if root and all(mark in root.attributes for mark in marks) else None


def _read_scene(root: Any, opened: OpenedStage) -> Scene:
    folders = root.nameChildren
    sky = None
    if ENVIRONMENT in folders:
        sky = _read_dome(folders[ENVIRONMENT], opened)
    prims = sorted(
        folders["Objects"].nameChildren, key=lambda p: p.attributes[layout.INDEX].default
    )
    objects = tuple(SceneObject(**_read_texts(prim, layout.OBJECT_TEXTS)) for prim in prims)
    _require(all(entry.kind in OBJECT_KINDS for entry in objects))
    cameras = [prim.attributes for prim in _list_by_row(folders["Cameras"], layout.camera_name)]
    poses = [np.array(camera["xformOp:transform"].default).T for camera in cameras]
    return Scene(
        **_read_meshes(root, [prim for prim in prims if prim.typeName == "Mesh"]),
        c2w=np.array(poses, np.float32),
        fov_deg=np.array([camera[layout.FOV_DEG].default for camera in cameras], np.float32),
        objects=objects,
        provenance=scene_provenance(json.loads(root.attributes[layout.PROVENANCE].default)),
        **_read_materials(folders["Materials"], opened),
        environment=sky,
    )


def _read_dome(prim: Any, opened: OpenedStage) -> Environment:
    """Read the environment that was written; raises LookupError without its file."""
    matrix = np.array(prim.attributes["xformOp:transform"].default).T
    return Environment(
        radiance_rgb=decode_exr(_read_asset(prim, layout.MAP_PATH, opened)),
        rotation=(matrix[:3, :3] @ layout.TO_OUR_AXES.T).astype(np.float32),
        is_seen=bool(prim.attributes[layout.VISIBLE_TO_CAMERA].default),
        source=MapSource(**_read_texts(prim, layout.MAP_TEXTS)),
    )


def _read_texts(prim: Any, attributes: Mapping[str, str]) -> dict[str, Any]:
    """Return the fields of a record that are texts, by the names of their attributes."""
    return {field: prim.attributes[name].default for field, name in attributes.items()}


def _read_meshes(root: Any, meshes: Sequence[Any]) -> dict[str, Any]:
    """Return the fields of a scene by vertex and by triangle, each placed by the rows of meshes."""
    rows = [_read_integers(root, layout.UNUSED_ROWS)]
    vertices = [_read_vectors(root, layout.UNUSED_POSITIONS, layout.UNUSED_NORMALS)]
    face_rows = []
    triangles = []
    uv = []
    for mesh in meshes:
        rows.append(_read_integers(mesh, layout.VERTEX_ROWS))
        placed = _read_vectors(mesh, "points", "normals")
        name = _OLD_CENTER if _OLD_CENTER in mesh.attributes else CENTER
        center = np.array(mesh.attributes[name].default, np.float64)
        placed[:, :3] = sum_positions(center, placed[:, :3])
        exact = _read_vectors(mesh, layout.EXACT_POSITIONS)
        placed[_read_integers(mesh, layout.EXACT_ROWS), :3] = exact
        vertices.append(placed)
        face_rows.append(_read_integers(mesh, layout.FACE_ROWS))
        faces = np.full((len(face_rows[-1]), 5), mesh.attributes[layout.INDEX].default)
        faces[:, :3] = rows[-1][_read_integers(mesh, "faceVertexIndices").reshape(-1, 3)]
        for subset in mesh.nameChildren:
            faces[_read_integers(subset, "indices"), 3] = int(subset.name.rpartition("_")[2])
        triangles.append(faces)
        if ST in mesh.attributes:
            uv.append(np.array(mesh.attributes[ST].default, np.float32).reshape(-1, 6))
    vertices_in_order = _place(vertices, rows)
    faces = _place(triangles, face_rows)
    return {
        "vertex_positions": vertices_in_order[:, :3].copy(),
        "vertex_normals": vertices_in_order[:, 3:].copy(),
        "faces": faces[:, :3].astype(np.uint32),
        "material_index": faces[:, 3].astype(np.uint16),
        "object_index": faces[:, 4].astype(np.uint16),
        "uv": _place(uv, face_rows).reshape(-1, 2) if uv else None,
    }


def _place(values: Sequence[NDArray], rows: Sequence[NDArray[np.int64]]) -> NDArray:
    """Return values in the order of their rows 0 to N - 1; some may repeat."""
    _, first = np.unique(np.concatenate(rows), return_index=True)
    return np.concatenate(values)[first]


def _read_materials(folder: Any, opened: OpenedStage) -> dict[str, Any]:
    """Return the fields of a scene on materials and textures; raises UndeclaredColumn."""
    prims = _list_by_row(folder, layout.material_name)
    rows = default_rows(len(prims))
    stored = (layout.column_of(attribute.name) for attribute in prims[0].attributes)
    columns = {*PUBLISHED_COLUMNS, *(declared_column(name).name for name in stored if name)}
    index = np.full((len(prims), len(SHADERS)), CONSTANT, np.int32)
    textures: dict[int, Texture] = {}
    for row, prim in enumerate(prims):
        for column, part in laid_out():
            if column.name in columns:
                rows[row, part] = prim.attributes[layout.column_attribute(column.name)].default
        for place, (name, shader) in enumerate(SHADERS.items()):
            if shader in prim.nameChildren:
                node = prim.nameChildren[shader]
                texture = node.attributes[layout.TEXTURE_ROW].default
                index[row, place] = texture
                if texture not in textures:
                    textures[texture] = _read_texture(node, name, opened)
    normals = index[:, len(TEXTURED)].copy()
    return {
        "materials": rows,
        "textures": tuple(textures[row] for row in range(len(textures))),
        "material_textures": index[:, : len(TEXTURED)].copy() if textures else None,
        "normal_textures": normals if (normals != CONSTANT).any() else None,
    }


def _read_texture(node: Any, column: str, opened: OpenedStage) -> Texture:
    return decode_texture(
        _read_asset(node, "inputs:file", opened),
        node.attributes["inputs:file"].default.path,
        column,
        is_srgb=node.attributes["inputs:sourceColorSpace"].default == "sRGB",
        source=MapSource(**_read_texts(node, layout.MAP_TEXTS)),
    )


def _read_asset(prim: Any, name: str, opened: OpenedStage) -> bytes:
    """Return the bytes of the file that an attribute names."""
    path = prim.attributes[name].default.path
    resolved = opened.resolve(prim.layer, path)
    data = None if resolved is None else asset_bytes(resolved, MAX_BYTES)
    if data is None:
        raise LookupError(path)
    return data


_NOT_AS_WRITTEN = (LookupError, TypeError, ValueError, AttributeError)
"""Errors of a layer that is not as export writes it."""
_PLAIN_INFO = {"specifier", "typeName", "apiSchemas", "documentation", "comment", "displayName"}
"""Metadata that does not change how a prim looks."""
_LOOKS = {"default", "typeName", "interpolation", "targetPaths", "connectionPaths"}
"""Metadata of prims and properties that does."""
_OLD_CENTER = "xformOp:translate:center"
"""Name of the transform to the center in older files, such as `examples/room.usdz`."""


def _list_specs(root: Any) -> dict[str, Any]:
    """Return what looks of a prim and all below it, by path; raises ValueError for more than that.

    A connection or a target has a path of its own, and stands in its property.
    """
    specs = dict[str, Any]()
    layer = root.layer

    def add_spec(path: Any) -> None:
        if path.IsTargetPath():
            return
        spec = layer.GetObjectAtPath(path)
        keys = spec.ListInfoKeys()
        _require(path.IsPropertyPath() or _PLAIN_INFO.issuperset(keys))
        _require("timeSamples" not in keys)
        look = {key: spec.GetInfo(key) for key in keys if key in _LOOKS}
        name = str(path).replace(_OLD_CENTER, CENTER)
        if name.endswith(".xformOpOrder"):
            look["default"] = [each.replace(_OLD_CENTER, CENTER) for each in spec.default]
        specs[name] = look

    layer.Traverse(root.path, add_spec)
    return specs


def _list_by_row(folder: Any, name: Callable[[int], str]) -> list[Any]:
    """Return the children of a prim in the order of their rows; look-ups by name are quadratic."""
    prims = {prim.name: prim for prim in folder.nameChildren}
    return [prims[name(row)] for row in range(len(prims))]


def _read_integers(prim: Any, name: str) -> NDArray[np.int64]:
    return np.array(prim.attributes[name].default, np.int64)


def _read_vectors(prim: Any, *names: str) -> NDArray[np.float32]:
    """Return the vectors of attributes, beside each other."""
    values = (np.array(prim.attributes[name].default, np.float32) for name in names)
    return np.concatenate([each.reshape(-1, 3) for each in values], axis=1)


def _require(condition: Any) -> None:
    if not condition:
        raise ValueError("the layer is not as export wrote it")
