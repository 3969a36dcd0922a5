"""Writes USD: `.usda`, `.usdc` or `.usdz`, with one scene or all scenes of a shard.

Stages are Z up, in meters, with a default prim; textures and an environment map are files next to
the stage, or in the archive. Equal scenes give equal bytes.
`prim_names` lists the paths; `read_exact_scene` reads them.
A camera has a pose and a lens, in tenths of a meter, on a square film of 36 mm. A `.usdz` file is a
zip archive of uncompressed members that begin at multiples of 64 bytes.
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

from pipeline.exchange.usd.authoring import Attributes, add_attributes, add_prim
from pipeline.exchange.usd.dome import add_dome, map_files, sky_attributes
from pipeline.exchange.usd.prim_names import (
    DIGEST,
    FOV_DEG,
    OBJECT_TEXTS,
    PROVENANCE,
    ROOT,
    SHARD_ROOT,
    UNUSED_NORMALS,
    UNUSED_POSITIONS,
    UNUSED_ROWS,
    VARIANT_SET,
    VERSION,
    camera_name,
)
from pipeline.exchange.usd.write_materials import add_materials
from pipeline.exchange.usd.write_meshes import add_objects
from pipeline.exchange.usd.write_textures import texture_files
from storage.atomic import write_atomically
from storage.conventions import SCHEMA_VERSION
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.retextured import without_constant_textures
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.records.scene_file import scene_digest

SUFFIXES = (".usda", ".usdc", ".usdz")

ENVIRONMENT = "Environment"
"""Name of the prim of an environment."""

CARRIED = frozenset(
    {*ARRAY_FIELDS, "provenance", "textures", "normal_textures", "environment"}
    | {f"objects.{field}" for field in OBJECT_TEXTS}
)
"""Members of a scene that the file holds (pipeline.exchange.formats)."""


def write_usd(path: Path, scene: Scene) -> None:
    """Write one scene; the file appears whole or not at all.

    Raises:
        TrilightError: the suffix is not USD's, the scene breaks a law or holds text that USD cannot
            store, or the file cannot be written.
    """
    layer = _new_layer(path, ROOT)
    _save(path, layer, _add_scene(layer, ROOT, scene))


def write_usd_shard(path: Path, scenes: Iterable[tuple[str, Scene]]) -> None:
    """Write many scenes as variants, named by their keys; programs show one at a time.

    Raises:
        TrilightError: as `write_usd`, or there is no scene.
    """
    from pxr import Sdf

    layer = _new_layer(path, SHARD_ROOT)
    root = add_prim(layer, SHARD_ROOT, "Xform")
    root.variantSetNameList.Prepend(VARIANT_SET)
    keys = []
    files = dict[str, bytes]()
    for key, scene in scenes:
        variant = f"{SHARD_ROOT}{{{VARIANT_SET}={key}}}"
        Sdf.CreatePrimInLayer(layer, variant)
        files |= _add_scene(layer, variant + ROOT.removeprefix("/"), scene)
        keys.append(key)
    if not keys:
        raise TrilightError(f"{path.name}: no scenes to write; expected at least one.")
    root.variantSelections[VARIANT_SET] = keys[0]
    _save(path, layer, files)


def root_attributes(scene: Scene) -> Attributes:
    """Return the attributes of the prim of a scene."""
    unused = np.ones(len(scene.vertex_positions), np.bool_)
    unused[scene.faces] = False
    rows = np.flatnonzero(unused)
    return {
        VERSION: ("int", SCHEMA_VERSION),
        DIGEST: ("string", scene_digest(scene)),
        PROVENANCE: ("string", canonical_json(dict(scene.provenance)).decode()),
        UNUSED_ROWS: ("int[]", rows.astype(np.int32)),
        UNUSED_POSITIONS: ("point3f[]", scene.vertex_positions[rows]),
        UNUSED_NORMALS: ("normal3f[]", scene.vertex_normals[rows]),
        **sky_attributes(scene.environment),
    }


def _add_scene(layer: Any, path: str, scene: Scene) -> dict[str, bytes]:
    """Write a scene into a layer; return its texture and map files by name."""
    scene.check()
    scene = without_constant_textures(scene)
    for entry in scene.objects:
        _require_text(entry.name, entry.uid, entry.licence, entry.attribution, entry.source_url)
    for texture in scene.textures:
        source = texture.source
        _require_text(source.name, source.licence, source.attribution, source.source_url)
    author_scene(layer, path, scene)
    return texture_files(scene) | map_files(scene.environment)


def author_scene(layer: Any, path: str, scene: Scene) -> Any:
    """Write the prims of a scene into a layer; return its root prim."""
    from pxr import Sdf

    with Sdf.ChangeBlock():
        root = add_prim(layer, path, "Xform")
        add_attributes(root, root_attributes(scene))
        add_materials(layer, f"{path}/Materials", scene)
        add_objects(layer, f"{path}/Objects", scene, f"{path}/Materials")
        add_cameras(layer, f"{path}/Cameras", scene)
        if scene.environment is not None:
            add_dome(layer, f"{path}/{ENVIRONMENT}", scene.environment)
    return root


def _require_text(*texts: str) -> None:
    for text in texts:
        if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
            raise TrilightError(f"names: {text!r:.80} has a character that USD cannot store.")


def _new_layer(path: Path, root: str) -> Any:
    if path.suffix.lower() not in SUFFIXES:
        raise TrilightError(f"{path.name}: expected a name that ends in {', '.join(SUFFIXES)}.")
    return new_layer(".usda" if path.suffix.lower() == ".usda" else ".usdc", root)


def new_layer(suffix: str, root: str) -> Any:
    """Return an empty layer in meters with +Z up, whose default prim is `root`."""
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(suffix)
    layer.defaultPrim = root.removeprefix("/")
    layer.pseudoRoot.SetInfo("upAxis", "Z")
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    return layer


def _save(path: Path, layer: Any, files: Mapping[str, bytes]) -> None:
    with tempfile.TemporaryDirectory(dir=path.parent if path.parent.is_dir() else None) as folder:
        plain = Path(folder) / "scene.usdc"
        if (
            path.suffix.lower() == ".usda"
        ):  # Export would change file modes, which a confined child may not
            data = layer.ExportToString().encode()
        elif layer.Export(str(plain)):
            data = plain.read_bytes()
        else:
            raise TrilightError(f"{path.name}: USD could not write the scene.")
    if path.suffix.lower() == ".usdz":
        write_atomically(path, encode_usdz(data, files))
        return
    for name, content in files.items():
        write_atomically(path.parent / name, content)
    write_atomically(path, data)  # last, so that the files that it names exist


APERTURE = 0.36
"""Width and height of the film in tenths of a meter."""

CLIP_METRES = (1e-3, 1e4)


def add_cameras(layer: Any, folder: str, scene: Scene) -> None:
    """Write a prim for each camera below `folder`."""
    add_prim(layer, folder, "Scope")
    for row in range(scene.num_views):
        camera = add_prim(layer, f"{folder}/{camera_name(row)}", "Camera")
        add_attributes(camera, camera_attributes(scene.c2w[row], float(scene.fov_deg[row])))


def camera_attributes(c2w: NDArray[np.float32], fov_deg: float) -> Attributes:
    """Return the attributes of a camera from its pose [4, 4] and full field of view in degrees."""
    focal = APERTURE / (2 * math.tan(math.radians(fov_deg) / 2))
    rows = c2w.astype(np.float64).T.tolist()  # USD multiplies rows from the left
    return {
        "xformOp:transform": ("matrix4d", rows),
        "xformOpOrder": ("uniform token[]", ("xformOp:transform",)),
        "projection": ("token", "perspective"),
        "focalLength": ("float", float(np.float32(focal))),
        "horizontalAperture": ("float", float(np.float32(APERTURE))),
        "verticalAperture": ("float", float(np.float32(APERTURE))),
        "clippingRange": ("float2", CLIP_METRES),
        FOV_DEG: ("float", fov_deg),
    }


ALIGNMENT = 64
LAYER_NAME = "scene.usdc"

_HEADER_BYTES = 30
_PADDING_ID = 0x1986
"""Identifier of the extra field that aligns the bytes of a zip member; readers skip it."""


def encode_usdz(layer: bytes, files: Mapping[str, bytes] | None = None) -> bytes:
    """Return the `.usdz` archive of a `.usdc` layer and its files, without time stamps."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {LAYER_NAME: layer, **(files or {})}.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            begin = stream.tell() + _HEADER_BYTES + len(name)
            padding = -(begin + 4) % ALIGNMENT
            entry.extra = _PADDING_ID.to_bytes(2, "little") + padding.to_bytes(2, "little")
            entry.extra += bytes(padding)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data)
    return stream.getvalue()
