"""The JSON of a glTF, checked before the mesh library sees it.

The library ignores what it does not know: sparse and compressed accessors read as zeros, fans are
skipped, a node with two parents is placed once. Each of these would give a plausible but wrong
mesh, so they are refused here by name. Textures are never opened, so their URIs are not looked at.
"""

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from pipeline.foreign.limits import ReadLimits
from storage.errors import Rejected

_MAX_JSON_BYTES = 64_000_000
_HARMLESS_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_")
"""A file may require these: they change how a surface looks, which we replace."""
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_FLOAT = 5126
_POINTS_AND_LINES = (0, 1, 2, 3)
_TRIANGLES = 4
_STRIP = 5


def read_tree(data: bytes, suffix: str) -> dict[str, Any]:
    """Return the JSON of a .gltf or .glb; raises Rejected `load_error` where there is none."""
    text = data
    if suffix == ".glb":
        length = int.from_bytes(data[12:16], "little")
        if data[:4] != b"glTF" or data[16:20] != b"JSON" or length > len(data) - 20:
            raise Rejected("load_error", "the file is no GLB, or is cut off in its first chunk")
        text = data[20 : 20 + length]
    if len(text) > _MAX_JSON_BYTES:
        raise Rejected("too_large_bytes", f"{len(text)} bytes of JSON; limit {_MAX_JSON_BYTES}")
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Rejected("load_error", f"the glTF JSON cannot be read ({error})") from error
    if not isinstance(tree, dict):
        raise Rejected("load_error", "the glTF JSON is not an object")
    return tree


def check_tree(tree: dict[str, Any], limits: ReadLimits) -> None:
    """Raise Rejected for a tree that would load wrongly, or as more than the limits."""
    try:
        _check_extensions(tree)
        faces = [
            sum(_count_faces(tree, primitive, limits) for primitive in mesh["primitives"])
            for mesh in tree.get("meshes", ())
        ]
        placed = _placed_meshes(tree, limits.max_instances)
        total = sum(faces[mesh] for mesh in placed)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise Rejected("load_error", f"the glTF tree is malformed ({error!r:.120})") from error
    if total > limits.max_faces:
        raise Rejected("too_many_faces", f"{total} faces; expected <= {limits.max_faces}")


def _check_extensions(tree: dict[str, Any]) -> None:
    """Refuse what the file cannot be read without.

    A file that uses compression without requiring it holds plain data as well, or marks its buffer
    as a mere place-holder.
    """
    for buffer in tree.get("buffers", ()):
        if any(entry.get("fallback") for entry in buffer.get("extensions", {}).values()):
            raise Rejected("compressed_geometry", "a buffer holds compressed geometry only")
    for name in tree.get("extensionsRequired", ()):
        if name in _COMPRESSED:
            raise Rejected(
                "compressed_geometry",
                f"the file requires {name}; unpack it first, for example with gltf-transform",
            )
        if not name.startswith(_HARMLESS_EXTENSIONS):
            raise Rejected("unsupported_extension", f"the file requires {name[:80]!r}")


def buffer_paths(tree: dict[str, Any], folder: Path) -> dict[str, Path]:
    """Return the files that the buffers name, by URI; raises Rejected `external_uri`.

    A buffer may lie in the file itself, in a `data:` URI, or in a file below `folder`.
    """
    paths: dict[str, Path] = {}
    root = folder.resolve()
    for buffer in tree.get("buffers", ()):
        uri = buffer.get("uri") if isinstance(buffer, dict) else None
        if uri is None or (isinstance(uri, str) and uri.startswith("data:")):
            continue
        parts = urlsplit(uri) if isinstance(uri, str) and "\x00" not in unquote(uri) else None
        if parts is None or parts.scheme or parts.netloc:
            raise Rejected("external_uri", f"a buffer lies at {str(uri)[:80]!r}, not in the folder")
        target = (root / unquote(uri)).resolve()
        if not target.is_relative_to(root):
            raise Rejected("external_uri", f"a buffer at {uri[:80]!r} lies outside the folder")
        paths[uri] = target
    return paths


def _count_faces(tree: dict[str, Any], primitive: dict[str, Any], limits: ReadLimits) -> int:
    mode = primitive.get("mode", _TRIANGLES)
    if mode in _POINTS_AND_LINES:
        return 0
    if mode not in (_TRIANGLES, _STRIP):
        raise Rejected("unsupported_primitive", f"a primitive has mode {mode}; expected 4 or 5")
    accessors = tree["accessors"]
    position = accessors[primitive["attributes"]["POSITION"]]
    corners = accessors[primitive["indices"]] if "indices" in primitive else position
    for accessor in (position, corners):
        if "bufferView" not in accessor or "sparse" in accessor:
            raise Rejected("unsupported_accessor", "geometry is compressed or sparse")
        if accessor["count"] > 3 * limits.max_faces:
            raise Rejected("too_many_faces", f"an accessor counts {accessor['count']} items")
    if position["componentType"] != _FLOAT:
        raise Rejected("unsupported_accessor", "positions are quantised")
    return int(corners["count"]) // 3 if mode == _TRIANGLES else int(corners["count"])


def _placed_meshes(tree: dict[str, Any], max_instances: int) -> list[int]:
    """Return the mesh of every node of the scene that has one."""
    scenes = tree.get("scenes", ())
    nodes = tree.get("nodes", ())
    waiting = list(scenes[tree.get("scene", 0)].get("nodes", ())) if scenes else []
    seen: set[int] = set()
    placed: list[int] = []
    while waiting:
        index = waiting.pop()
        if index in seen:
            raise Rejected(
                "scene_cycle", f"node {index} is reached twice; glTF demands a strict tree"
            )
        seen.add(index)
        waiting.extend(nodes[index].get("children", ()))
        if "mesh" in nodes[index]:
            _check_pose(tree, nodes[index])
            placed.append(nodes[index]["mesh"])
        if len(placed) > max_instances:
            raise Rejected("too_many_instances", f"more than {max_instances} nodes place a mesh")
    return placed


def _check_pose(tree: dict[str, Any], node: dict[str, Any]) -> None:
    """Refuse a mesh whose vertices are moved by bones or morph targets: the library ignores both.

    Targets that all weigh nothing leave the mesh as it is.
    """
    if "skin" in node:
        raise Rejected("skinned_mesh", "bones pose a mesh; apply the skin before exporting")
    weights = node.get("weights", tree["meshes"][node["mesh"]].get("weights", ()))
    if any(weights):
        raise Rejected("morphed_mesh", "morph targets shape a mesh; apply them before exporting")
