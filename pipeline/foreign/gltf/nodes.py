"""The nodes of a glTF scene with their transforms to world space, and checks of its tree.

World space is in meters, +Z up. Before any buffer is read, features that would give a plausible but
wrong mesh are refused by name: compressed geometry without plain data, skins, and required
extensions that are unknown. `list_unread_parts` names, each once a file, contents that no code here
reads.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        if name not in _READ | _CHANGES_NOTHING and not name.startswith(_SURFACE_EXTENSIONS):
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


_READ = frozenset(
    "EXT_mesh_gpu_instancing EXT_texture_webp KHR_lights_punctual KHR_materials_emissive_strength "
    "KHR_materials_ior KHR_materials_pbrSpecularGlossiness KHR_materials_specular "
    "KHR_materials_unlit KHR_mesh_quantization KHR_node_visibility KHR_texture_transform".split()
)
_CHANGES_NOTHING = frozenset(
    "CESIUM_primitive_outline EXT_instance_features EXT_mesh_features EXT_mesh_manifold "
    "EXT_structural_metadata FB_geometry_metadata GODOT_single_root KHR_animation_pointer "
    "KHR_node_hoverability KHR_node_selectability KHR_xmp KHR_xmp_json_ld MSFT_lod".split()
)
"""Extensions for metadata, animation, and coarser copies of meshes."""
_NAMED_ELSEWHERE = frozenset(
    "EXT_meshopt_compression KHR_draco_mesh_compression KHR_meshopt_compression "
    "KHR_materials_anisotropy KHR_materials_clearcoat KHR_materials_iridescence "
    "KHR_materials_sheen KHR_materials_transmission".split()
)
"""Compression beside plain data, which is read, and features that `SourceMaterial.lost` names."""

_KEYS: Mapping[str, str] = {
    "the file": "asset scene scenes nodes meshes accessors bufferViews buffers materials textures "
    "images samplers cameras skins animations extensionsUsed extensionsRequired",
    "scenes": "nodes name",
    "nodes": "mesh camera skin children matrix rotation scale translation weights name",
    "meshes": "primitives weights name",
    "primitives": "attributes indices material mode targets",
    "materials": "name pbrMetallicRoughness normalTexture occlusionTexture emissiveTexture "
    "emissiveFactor alphaMode alphaCutoff doubleSided",
    "accessors": "bufferView byteOffset componentType normalized count type max min sparse name",
}
"""Keys of glTF 2.0 by the list that holds them."""

_ATTRIBUTES: Mapping[str, tuple[str, ...]] = {
    "primitives": ("POSITION", "NORMAL", "TANGENT", "COLOR_0", "TEXCOORD_", "JOINTS_", "WEIGHTS_"),
    "nodes, EXT_mesh_gpu_instancing": ("TRANSLATION", "ROTATION", "SCALE"),
}
"""Prefixes of attributes that are read, or that only skins have."""


def list_unread_parts(tree: Mapping[str, Any]) -> tuple[str, ...]:
    """Return sentences on contents that no code reads; malformed files are refused elsewhere."""
    extensions: dict[str, str] = {}
    sentences: dict[str, None] = {}
    for kind, row in _rows(tree):
        for name in row.get("extensions", ()):
            if extensions.get(name, "the file") == "the file":
                extensions[name] = kind
        sentences |= dict.fromkeys(_list_unread(kind, row))
    for name in tree.get("extensionsUsed", ()):
        extensions.setdefault(name, "the file")
    silent = _READ | _CHANGES_NOTHING | _NAMED_ELSEWHERE
    named = [
        f"extension {name!r:.80} of {kind}"
        for name, kind in extensions.items()
        if name not in silent
    ]
    return (*named, *sentences)


def _rows(tree: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every JSON object of a tree outside of `extras`, with the name of its list."""
    waiting: list[tuple[str, Any]] = [("the file", tree)]
    while waiting:
        kind, value = waiting.pop()
        if isinstance(value, dict):
            yield kind, value
            for key, inner in value.items():
                if key == "extensions" and isinstance(inner, dict):
                    waiting += [(f"{kind}, {name}", each) for name, each in inner.items()]
                elif key != "extras" and isinstance(inner, (dict, list)):
                    inside = kind == "the file" or key == "primitives"
                    waiting.append((key if inside else f"{kind}, {key}", inner))
        elif isinstance(value, list):
            waiting += [(kind, each) for each in value if isinstance(each, (dict, list))]


def _list_unread(kind: str, row: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on one JSON object of the tree, its extensions excluded."""
    if "extras" in row:
        yield f"data of other programs (extras) of {kind}"
    if kind in _KEYS:
        known = {*_KEYS[kind].split(), "extensions", "extras"}
        yield from (f"key {key!r:.60} of {kind}" for key in row if key not in known)
    if kind in _ATTRIBUTES:
        names = row.get("attributes", ())
        unknown = (name for name in names if not name.startswith(_ATTRIBUTES[kind]))
        yield from (f"attribute {name!r:.60} of {kind}" for name in unknown)
    if kind == "primitives":
        if row.get("mode", TRIANGLES) in POINTS_AND_LINES:
            yield "points and lines"
        elif "POSITION" not in row.get("attributes", ()):
            yield "primitives without positions"
    if kind == "materials" and "occlusionTexture" in row:
        yield "occlusion maps of materials: light is traced"
    if kind == "the file" and row.get("animations"):
        yield "animations: everything stands as it does without them"
    if kind == "the file" and len(row.get("scenes", ())) > 1:
        yield f"{len(row['scenes']) - 1} of {len(row['scenes'])} scenes: the default one is read"


INSTANCING = "EXT_mesh_gpu_instancing"

_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""glTF has +Y up and +Z towards the viewer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedNode:
    """A node with its world transform."""

    node: dict[str, Any]
    """JSON object of the node."""
    to_world: NDArray[np.float64]
    """[4, 4] matrix for column vectors, to meters with +Z up."""
    is_visible: bool
    """True where the node's meshes and lights are shown (KHR_node_visibility)."""


def entry(tree: Mapping[str, Any], kind: str, index: Any) -> dict[str, Any]:
    """Return an entry of a list of the tree; raises Malformed for an index out of range."""
    rows = tree.get(kind, ())
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(rows):
        raise Malformed(f"{kind} {index!r:.20} of {len(rows)}")
    row = rows[index]
    if not isinstance(row, dict):
        raise Malformed(f"{kind} {index} is no object")
    return row


def extension(row: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return an extension of an entry; empty where it has none."""
    value = row.get("extensions", {}).get(name, {})
    return value if isinstance(value, dict) else {}


def placed_nodes(tree: Mapping[str, Any]) -> Iterator[PlacedNode]:
    """Yield the nodes of the default scene, or else of the first one, parents before children.

    All nodes count in a file without scenes.

    Raises:
        Rejected: scene_cycle.
    """
    seen: set[int] = set()
    waiting = [(index, _TO_Z_UP, True) for index in reversed(_roots(tree))]
    while waiting:
        index, above, is_visible = waiting.pop()
        node = entry(tree, "nodes", index)
        if index in seen:
            raise Rejected(
                "scene_cycle", f"node {index} is reached twice; glTF demands a strict tree"
            )
        seen.add(index)
        to_world = np.einsum("ij,jk->ik", above, _local(node))
        is_visible &= extension(node, "KHR_node_visibility").get("visible", True) is not False
        yield PlacedNode(node=node, to_world=to_world, is_visible=is_visible)
        children = reversed(node.get("children", ()))
        waiting += [(child, to_world, is_visible) for child in children]


def placed_meshes(tree: Mapping[str, Any]) -> Iterator[PlacedNode]:
    """Yield visible nodes with a mesh; raises Rejected nonfinite_vertices or scene_cycle."""
    for placed in placed_nodes(tree):
        if "mesh" in placed.node and placed.is_visible:
            if not np.isfinite(placed.to_world).all():
                fields = ("matrix", "translation", "rotation", "scale", "name")
                stated = {name: placed.node[name] for name in fields if name in placed.node}
                raise Rejected(
                    "nonfinite_vertices", f"a node or one above it has a place {stated!r:.120}"
                )
            yield placed


def _roots(tree: Mapping[str, Any]) -> list[int]:
    if tree.get("scenes"):
        return list(entry(tree, "scenes", tree.get("scene", 0)).get("nodes", ()))
    nodes = tree.get("nodes", ())
    below = {child for node in nodes for child in node.get("children", ())}
    return [index for index in range(len(nodes)) if index not in below]


def _local(node: Mapping[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column by column
    return transforms(
        *(
            np.array(node.get(name, default), np.float64).reshape(1, len(default))
            for name, default in TRS
        )
    )[0]


TRS = (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))
"""Components of a transform with their defaults."""


def transforms(
    translation: NDArray[np.float64], rotation: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return matrices [N, 4, 4] of translations [N, 3], quaternions [N, 4] and scales [N, 3]."""
    x, y, z, w = rotation.T
    length = x * x + y * y + z * z + w * w
    twice = np.divide(2, length, out=np.zeros_like(length), where=length > 0)
    rows: Any = [
        [1 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)],
        [twice * (x * y + z * w), 1 - twice * (x * x + z * z), twice * (y * z - x * w)],
        [twice * (x * z - y * w), twice * (y * z + x * w), 1 - twice * (x * x + y * y)],
    ]
    rotations = np.moveaxis(np.array(rows, np.float64), 2, 0)
    matrices = np.tile(np.eye(4), (len(x), 1, 1))
    matrices[:, :3, :3] = rotations * scale[:, None]
    matrices[:, :3, 3] = translation
    return matrices


def num_instances(tree: Mapping[str, Any], node: Mapping[str, Any]) -> int:
    """Return the number of instances of a node; raises Malformed where attributes disagree."""
    attributes = extension(node, INSTANCING).get("attributes", {})
    counts = {
        read_count(entry(tree, "accessors", number), "count") for number in attributes.values()
    }
    if len(counts) > 1:
        raise Malformed(f"the instances of a node have attributes of {sorted(counts)} values")
    return counts.pop() if counts else 1
