"""Writes USD: `.usda`, `.usdc` or `.usdz`, with one scene or all scenes of a shard.

Stages are Z up, in meters, with a default prim; textures and an environment map are files next to
the stage, or in the archive. Equal scenes give equal bytes.
`layout` lists the paths; `read_usd` reads them.
A camera has a pose and a lens, in tenths of a meter, on a square film of 36 mm. A `.usdz` file is a
zip archive of uncompressed members that begin at multiples of 64 bytes.

The origin of a mesh is the center of its bounding box, since other programs rotate and scale an
object about its origin; points are relative to it. Where center plus point in float32 differs from
the position, an attribute holds the exact position.

An emitter is emissive geometry and a light: its material emits, and `MeshLightAPI` with its default
`materialGlowTintsLight` and a white intensity of 1 emits the radiance of the material. The map of
an environment is an OpenEXR of float32, because half floats end below the radiance of suns.
"""

import io
import math
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Tf

from pipeline.exchange.usd import layout
from pipeline.exchange.usd.write_materials import ST, add_materials, map_files, sky_file
from pipeline.foreign.limits import WRITTEN_USD_SUFFIXES
from pipeline.foreign.usd.stage import without_warnings
from storage.atomic import write_atomically
from storage.conventions import SCHEMA_VERSION
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from storage.records.texture import Environment

ENVIRONMENT = "Environment"
"""Name of the prim of an environment."""


def write_usd(path: Path, scene: Scene) -> tuple[()]:
    """Write one scene; the file appears whole or not at all. No member loses anything.

    Raises:
        TrilightError: the suffix is not USD's, the scene breaks a law or holds text that USD cannot
            store, or the file cannot be written.
    """
    layer = new_layer(layout.ROOT)
    _save(path, layer, _add_scene(layer, layout.ROOT, scene))
    return ()


def write_usd_shard(path: Path, scenes: Iterable[tuple[str, Scene]]) -> None:
    """Write many scenes as variants, named by their keys; programs show one at a time.

    The point and the minus of a time code, which a name must not contain, become `_` and `m`.

    Raises:
        TrilightError: as `write_usd`, or there is no scene.
    """
    layer = new_layer(layout.SHARD_ROOT)
    root = layout.add_prim(layer, layout.SHARD_ROOT, "Xform")
    root.variantSetNameList.Prepend(layout.VARIANT_SET)
    keys = []
    files = dict[str, bytes]()
    for stated_key, scene in scenes:
        key = stated_key.replace(".", "_").replace("-", "m")
        variant = f"{layout.SHARD_ROOT}{{{layout.VARIANT_SET}={key}}}"
        Sdf.CreatePrimInLayer(layer, variant)
        files |= _add_scene(layer, variant + layout.ROOT.removeprefix("/"), scene)
        keys.append(key)
    if not keys:
        raise TrilightError(f"{path.name}: no scenes to write; expected at least one.")
    root.variantSelections[layout.VARIANT_SET] = keys[0]
    _save(path, layer, files)


def root_attributes(scene: Scene) -> layout.Attributes:
    """Return the attributes of the prim of a scene."""
    unused = np.ones(len(scene.vertex_positions), np.bool_)
    unused[scene.faces] = False
    rows = np.flatnonzero(unused)
    return {
        layout.VERSION: ("int", SCHEMA_VERSION),
        layout.DIGEST: ("string", scene_digest(scene)),
        layout.PROVENANCE: ("string", canonical_json(dict(scene.provenance)).decode()),
        layout.UNUSED_ROWS: ("int[]", rows.astype(np.int32)),
        layout.UNUSED_POSITIONS: ("point3f[]", scene.vertex_positions[rows]),
        layout.UNUSED_NORMALS: ("normal3f[]", scene.vertex_normals[rows]),
        **_sky_attributes(scene.environment),
    }


def _add_scene(layer: Any, path: str, scene: Scene) -> dict[str, bytes]:
    """Write a scene into a layer; return its texture and map files by name."""
    scene.check()
    scene = without_constant_textures(scene)
    sources = [texture.source for texture in scene.textures]
    texts = [getattr(each, field) for each in scene.objects for field in layout.OBJECT_TEXTS]
    texts += [getattr(each, field) for each in sources for field in layout.MAP_TEXTS]
    for text in texts:
        if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
            raise TrilightError(f"names: {text!r:.80} has a character that USD cannot store.")
    author_scene(layer, path, scene)
    return map_files(scene)


def author_scene(layer: Any, path: str, scene: Scene) -> Any:
    """Write the prims of a scene into a layer; return its root prim."""
    with Sdf.ChangeBlock():
        root = layout.add_prim(layer, path, "Xform")
        layout.add_attributes(root, root_attributes(scene))
        add_materials(layer, f"{path}/Materials", scene)
        _add_objects(layer, f"{path}/Objects", scene, f"{path}/Materials")
        _add_cameras(layer, f"{path}/Cameras", scene)
        if scene.environment is not None:
            dome = layout.add_prim(layer, f"{path}/{ENVIRONMENT}", "DomeLight")
            layout.add_attributes(dome, _dome_attributes(scene.environment))
    return root


def new_layer(root: str) -> Any:
    """Return an empty layer in meters with +Z up, whose default prim is `root`."""
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.defaultPrim = root.removeprefix("/")
    layer.pseudoRoot.SetInfo("upAxis", "Z")
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    return layer


def _save(path: Path, layer: Any, files: Mapping[str, bytes]) -> None:
    suffix = path.suffix.lower()
    if suffix not in WRITTEN_USD_SUFFIXES:
        expected = ", ".join(WRITTEN_USD_SUFFIXES)
        raise TrilightError(f"{path.name}: expected a name that ends in {expected}.")
    if suffix == ".usda":  # Export would change file modes, which a child may not
        data = layer.ExportToString().encode()
    else:
        within = path.parent if path.parent.is_dir() else None
        with tempfile.TemporaryDirectory(dir=within) as folder:
            plain = Path(folder) / _LAYER_NAME
            with without_warnings():  # such as that a confined child may not set a file's mode
                is_written = layer.Export(str(plain))
            if not is_written:
                raise TrilightError(f"{path.name}: USD could not write the scene.")
            data = plain.read_bytes()
    if suffix == ".usdz":
        write_atomically(path, encode_usdz(data, files))
        return
    for name, content in files.items():
        write_atomically(path.parent / name, content)
    write_atomically(path, data)  # last, so that the files that it names exist


_BINDING = "material:binding"
_LIGHT: layout.Attributes = {
    "inputs:intensity": ("float", 1.0),
    "inputs:exposure": ("float", 0.0),
    "inputs:color": ("color3f", (1.0, 1.0, 1.0)),
    "inputs:normalize": ("bool", False),
    "light:materialSyncMode": ("uniform token", "materialGlowTintsLight"),
}
_MESH: layout.Attributes = {
    "doubleSided": ("uniform bool", True),
    "orientation": ("uniform token", "rightHanded"),
    "subdivisionScheme": ("uniform token", "none"),
    "subsetFamily:materialBind:familyType": ("uniform token", "partition"),
}
CENTER = "xformOp:translate"
"""Name of the transform to the center, which USD's common API sets."""

_SUBSET: layout.Attributes = {
    "elementType": ("uniform token", "face"),
    "familyName": ("uniform token", "materialBind"),
}


def _add_objects(layer: Any, folder: str, scene: Scene, materials: str) -> None:
    """Write a prim for each object below `folder`; the materials are below `materials`."""
    layout.add_prim(layer, folder, "Scope")
    order = np.argsort(scene.object_index, kind="stable")
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    groups = np.split(order, np.cumsum(counts)[:-1])
    for row, (name, faces) in enumerate(zip(prim_names(scene), groups, strict=True)):
        _add_object(layer, f"{folder}/{name}", scene, row, faces, materials)


def prim_names(scene: Scene) -> list[str]:
    """Return a unique and valid USD name for each object."""
    taken: set[str] = set()
    unique = []
    for row, entry in enumerate(scene.objects):
        name = Tf.MakeValidIdentifier(entry.name or "object")
        while name in taken:
            name = f"{name}_{row}"
        taken.add(name)
        unique.append(name)
    return unique


def _add_object(
    layer: Any, path: str, scene: Scene, row: int, faces: NDArray[np.intp], materials: str
) -> None:
    entry = scene.objects[row]
    emits = entry.kind == "emitter"
    attributes = {
        layout.INDEX: ("int", row),
        **layout.text_attributes(layout.OBJECT_TEXTS, entry),
        layout.VISIBLE_TO_CAMERA: ("bool", not emits),
        **(_LIGHT if emits else {}),
    }
    if len(faces) == 0:
        layout.add_attributes(layout.add_prim(layer, path, "Xform"), attributes)
        return
    schemas = ["MaterialBindingAPI", *(["MeshLightAPI"] if emits else [])]
    prim = layout.add_prim(layer, path, "Mesh", schemas)
    layout.add_attributes(prim, {**attributes, **_MESH, **_mesh_arrays(scene, faces)})
    prim.attributes["normals"].SetInfo("interpolation", "vertex")
    if scene.uv is not None:
        prim.attributes[ST].SetInfo("interpolation", "faceVarying")
    index = scene.material_index[faces]
    used = np.unique(index)
    layout.add_relationship(prim, _BINDING, f"{materials}/{layout.material_name(used[0])}")
    for material in used:
        name = layout.material_name(material)
        subset = layout.add_prim(layer, f"{path}/{name}", "GeomSubset", ["MaterialBindingAPI"])
        chosen = np.flatnonzero(index == material).astype(np.int32)
        layout.add_attributes(subset, {**_SUBSET, "indices": ("int[]", chosen)})
        layout.add_relationship(subset, _BINDING, f"{materials}/{name}")


def sum_positions(center: NDArray[np.float64], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the float32 positions of points [V, 3] about a center."""
    return (points.astype(np.float64) + center).astype(np.float32)


def _mesh_arrays(scene: Scene, faces: NDArray[np.intp]) -> layout.Attributes:
    """Return the arrays of a mesh, with exact positions where center plus point differs."""
    rows, corners = np.unique(scene.faces[faces], return_inverse=True)
    positions = scene.vertex_positions[rows]
    wide = positions.astype(np.float64)
    middle = (wide.min(axis=0) + wide.max(axis=0)) / 2
    center = middle.astype(np.float32).astype(np.float64)
    points = (wide - center).astype(np.float32)
    same = sum_positions(center, points).view(np.uint32) == positions.view(np.uint32)
    exact = np.flatnonzero(~same.all(axis=1))
    uv = None if scene.uv is None else scene.uv.reshape(-1, 3, 2)[faces].reshape(-1, 2)
    return {
        CENTER: ("double3", center.tolist()),
        "xformOpOrder": ("uniform token[]", (CENTER,)),
        layout.EXACT_ROWS: ("int[]", exact.astype(np.int32)),
        layout.EXACT_POSITIONS: ("point3f[]", positions[exact]),
        "faceVertexCounts": ("int[]", np.full(len(faces), 3, np.int32)),
        "faceVertexIndices": ("int[]", corners.ravel().astype(np.int32)),
        "points": ("point3f[]", points),
        "normals": ("normal3f[]", scene.vertex_normals[rows]),
        "extent": ("float3[]", np.stack([points.min(axis=0), points.max(axis=0)])),
        layout.VERTEX_ROWS: ("int[]", rows.astype(np.int32)),
        layout.FACE_ROWS: ("int[]", faces.astype(np.int32)),
        **({} if uv is None else {ST: ("texCoord2f[]", uv)}),
    }


def _dome_attributes(sky: Environment) -> layout.Attributes:
    """Return the attributes of the prim of an environment."""
    to_world = np.eye(4)
    to_world[:3, :3] = sky.rotation.astype(np.float64) @ layout.TO_OUR_AXES
    return {
        "xformOp:transform": ("matrix4d", to_world.T.tolist()),  # USD multiplies from the left
        "xformOpOrder": ("uniform token[]", ("xformOp:transform",)),
        layout.MAP_PATH: ("asset", f"./{sky_file(sky)}"),
        "inputs:texture:format": ("token", "latlong"),
        "inputs:intensity": ("float", 1.0),
        layout.VISIBLE_TO_CAMERA: ("bool", sky.is_seen),
        **layout.text_attributes(layout.MAP_TEXTS, sky.source),
    }


def _sky_attributes(sky: Environment | None) -> layout.Attributes:
    """Return the attributes of a scene's prim about its environment; empty without one."""
    if sky is None:
        return {}
    return {
        **{
            name: ("float3", tuple(map(float, row)))
            for name, row in zip(layout.SKY_ROWS, sky.rotation, strict=True)
        },
        layout.SKY_VISIBLE: ("bool", sky.is_seen),
        layout.SKY_SOURCE: ("string", layout.format_map(sky.sha256, sky.source)),
    }


_APERTURE = 0.36
"""Width and height of the film in tenths of a meter."""

_CLIP_METERS = (1e-3, 1e4)


def _add_cameras(layer: Any, folder: str, scene: Scene) -> None:
    """Write a prim for each camera below `folder`."""
    layout.add_prim(layer, folder, "Scope")
    for row, (c2w, fov_deg) in enumerate(zip(scene.c2w, scene.fov_deg.tolist(), strict=True)):
        focal = _APERTURE / (2 * math.tan(math.radians(fov_deg) / 2))
        camera = layout.add_prim(layer, f"{folder}/{layout.camera_name(row)}", "Camera")
        attributes: layout.Attributes = {
            # USD multiplies rows from the left
            "xformOp:transform": ("matrix4d", c2w.astype(np.float64).T.tolist()),
            "xformOpOrder": ("uniform token[]", ("xformOp:transform",)),
            "projection": ("token", "perspective"),
            "focalLength": ("float", float(np.float32(focal))),
            "horizontalAperture": ("float", float(np.float32(_APERTURE))),
            "verticalAperture": ("float", float(np.float32(_APERTURE))),
            "clippingRange": ("float2", _CLIP_METERS),
            layout.FOV_DEG: ("float", fov_deg),
        }
        layout.add_attributes(camera, attributes)


_ALIGNMENT = 64
_LAYER_NAME = "scene.usdc"

_HEADER_BYTES = 30
_PADDING_ID = 0x1986
"""Identifier of the extra field that aligns the bytes of a zip member; readers skip it."""


def encode_usdz(layer: bytes, files: Mapping[str, bytes]) -> bytes:
    """Return the `.usdz` archive of a `.usdc` layer and its files, without time stamps."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {_LAYER_NAME: layer, **files}.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            begin = stream.tell() + _HEADER_BYTES + len(name)
            padding = -(begin + 4) % _ALIGNMENT
            entry.extra = _PADDING_ID.to_bytes(2, "little") + padding.to_bytes(2, "little")
            entry.extra += bytes(padding)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data)
    return stream.getvalue()
