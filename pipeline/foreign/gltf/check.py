"""Checks of a glTF before any buffer is read: refused features, and counts within limits.

Features that would give a plausible but wrong mesh are refused by name: compressed geometry without
plain data, skins, and required extensions that are unknown.
"""

from typing import Any

from pipeline.foreign.gltf.nodes import entry, num_instances, placed_meshes
from pipeline.foreign.gltf.unread import is_known
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.numbers import Malformed, read_count
from storage.errors import Rejected

_SURFACE_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_")
"""Prefixes of extensions that a file may require: they only change how a surface looks."""
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_UNPACK = "unpack it first, for example with gltf-transform"
_LISTS = ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers")
POINTS_AND_LINES = (0, 1, 2, 3)
TRIANGLES = 4
STRIP = 5
FAN = 6


def check_tree(tree: dict[str, Any], limits: ReadLimits) -> None:
    """Raise Rejected for a tree that would load wrongly or exceeds the limits."""
    for kind in _LISTS:
        if not isinstance(tree.get(kind, []), list):
            raise Malformed(f"{kind} is no list")
    _check_extensions(tree)
    faces: dict[int, int] = {}
    num_placed = num_faces = 0
    for placed in placed_meshes(tree):
        if "skin" in placed.node:
            raise Rejected("skinned_mesh", "bones pose a mesh; apply the skin before exporting")
        number = placed.node["mesh"]
        if number not in faces:
            faces[number] = sum(
                _count_faces(tree, primitive, limits)
                for primitive in entry(tree, "meshes", number)["primitives"]
            )
        count = num_instances(tree, placed.node)
        num_placed += count
        num_faces += count * faces[number]
        if num_placed > limits.max_instances:
            raise Rejected(
                "too_many_instances", f"more than {limits.max_instances} nodes place a mesh"
            )
    if num_faces > limits.max_faces:
        raise Rejected("too_many_faces", f"{num_faces} faces; expected <= {limits.max_faces}")


def _check_extensions(tree: dict[str, Any]) -> None:
    """Refuse required extensions that are not supported.

    A file that uses compression without requiring it holds plain data as well.
    """
    for buffer in tree.get("buffers", ()):
        is_fallback = any(each.get("fallback") for each in buffer.get("extensions", {}).values())
        if is_fallback and "uri" not in buffer:
            raise Rejected("compressed_geometry", f"a buffer is compressed only; {_UNPACK}")
    for name in tree.get("extensionsRequired", ()):
        if name in _COMPRESSED:
            raise Rejected("compressed_geometry", f"the file requires {name}; {_UNPACK}")
        if not (is_known(name) or name.startswith(_SURFACE_EXTENSIONS)):
            raise Rejected("unsupported_extension", f"the file requires {name[:80]!r}")


def _count_faces(tree: dict[str, Any], primitive: dict[str, Any], limits: ReadLimits) -> int:
    mode = primitive.get("mode", TRIANGLES)
    if mode in POINTS_AND_LINES or "POSITION" not in primitive["attributes"]:
        return 0
    if mode not in (TRIANGLES, STRIP, FAN):
        raise Rejected("unsupported_primitive", f"a primitive has mode {mode!r:.20}; expected 0-6")
    numbers = [primitive["attributes"]["POSITION"]]
    numbers += [primitive["indices"]] if "indices" in primitive else []
    counts = []
    for number in numbers:
        accessor = entry(tree, "accessors", number)
        if "bufferView" not in accessor and _COMPRESSED[0] in primitive.get("extensions", {}):
            raise Rejected("compressed_geometry", f"a mesh has compressed geometry only; {_UNPACK}")
        counts.append(read_count(accessor, "count"))
        if counts[-1] > 3 * limits.max_faces:
            raise Rejected("too_many_faces", f"an accessor counts {counts[-1]} items")
    return counts[-1] // 3 if mode == TRIANGLES else max(counts[-1] - 2, 0)
