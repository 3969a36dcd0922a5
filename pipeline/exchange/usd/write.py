"""`Scene` to USD: `.usda`, `.usdc` or `.usdz`, one scene or the scenes of a whole shard.

Z up, metres, a default prim, nothing that names a file. Equal scenes give equal bytes.
`pipeline.exchange.usd.names` says what stands where, `pipeline.exchange.usd.read_ours` reads it
back.
"""

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.exchange.usd.authoring import Attributes, add_attributes, add_prim
from pipeline.exchange.usd.names import (
    DIGEST,
    OBJECT_TEXTS,
    PROVENANCE,
    ROOT,
    SHARD_ROOT,
    UNUSED_NORMALS,
    UNUSED_POSITIONS,
    UNUSED_ROWS,
    VARIANT_SET,
    VERSION,
)
from pipeline.exchange.usd.package import packaged
from pipeline.exchange.usd.write_cameras import add_cameras
from pipeline.exchange.usd.write_materials import add_materials
from pipeline.exchange.usd.write_meshes import add_objects
from storage.atomic import write_atomically
from storage.conventions import SCHEMA_VERSION
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.records.scene_file import scene_digest

SUFFIXES = (".usda", ".usdc", ".usdz")

CARRIED = frozenset({*ARRAY_FIELDS, "provenance"} | {f"objects.{field}" for field in OBJECT_TEXTS})
"""Of a scene (storage.records.carried)."""


def write_usd(path: Path, scene: Scene) -> None:
    """Write one scene; the file appears whole or not at all.

    Raises:
        TrilightError: another suffix, the scene breaks a law or holds text that USD cannot keep, or
            the file cannot be written.
    """
    layer = _new_layer(path, ROOT)
    _add_scene(layer, ROOT, scene)
    _save(path, layer)


def write_usd_shard(path: Path, scenes: Iterable[tuple[str, Scene]]) -> None:
    """Write many scenes under their keys, as variants of which a program shows one at a time.

    Raises:
        TrilightError: as `write_usd`, or there is no scene.
    """
    from pxr import Sdf

    layer = _new_layer(path, SHARD_ROOT)
    root = add_prim(layer, SHARD_ROOT, "Xform")
    root.variantSetNameList.Prepend(VARIANT_SET)
    keys = []
    for key, scene in scenes:
        variant = f"{SHARD_ROOT}{{{VARIANT_SET}={key}}}"
        Sdf.CreatePrimInLayer(layer, variant)
        _add_scene(layer, variant + ROOT.removeprefix("/"), scene)
        keys.append(key)
    if not keys:
        raise TrilightError(f"{path.name}: no scenes to write; expected at least one.")
    root.variantSelections[VARIANT_SET] = keys[0]
    _save(path, layer)


def root_attributes(scene: Scene) -> Attributes:
    """Return what stands on the prim of a scene."""
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
    }


def _add_scene(layer: Any, path: str, scene: Scene) -> None:
    from pxr import Sdf

    scene.check()
    for entry in scene.objects:
        _require_text(entry.name, entry.uid, entry.licence, entry.attribution, entry.source_url)
    with Sdf.ChangeBlock():
        add_attributes(add_prim(layer, path, "Xform"), root_attributes(scene))
        add_materials(layer, f"{path}/Materials", scene.materials)
        add_objects(layer, f"{path}/Objects", scene, f"{path}/Materials")
        add_cameras(layer, f"{path}/Cameras", scene)


def _require_text(*texts: str) -> None:
    for text in texts:
        if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
            raise TrilightError(f"objects: {text!r:.80} holds a letter that USD cannot keep.")


def _new_layer(path: Path, root: str) -> Any:
    from pxr import Sdf

    if path.suffix.lower() not in SUFFIXES:
        raise TrilightError(f"{path.name}: expected a name that ends in {', '.join(SUFFIXES)}.")
    layer = Sdf.Layer.CreateAnonymous(".usda" if path.suffix.lower() == ".usda" else ".usdc")
    layer.defaultPrim = root.removeprefix("/")
    layer.pseudoRoot.SetInfo("upAxis", "Z")
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    return layer


def _save(path: Path, layer: Any) -> None:
    suffix = ".usda" if path.suffix.lower() == ".usda" else ".usdc"
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / f"scene{suffix}"
        if not layer.Export(str(plain)):
            raise TrilightError(f"{path.name}: USD could not write the scene.")
        data = plain.read_bytes()
    write_atomically(path, packaged(data) if path.suffix.lower() == ".usdz" else data)
