"""Short sentences on contents of a glTF that no code here reads, each once a file."""

from collections.abc import Iterator, Mapping
from typing import Any

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


def is_known(name: str) -> bool:
    """Return whether an extension is read, or changes no triangle, color or light."""
    return name in _READ or name in _CHANGES_NOTHING


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
        yield f"extras of {kind}"
    if kind in _KEYS:
        known = {*_KEYS[kind].split(), "extensions", "extras"}
        yield from (f"key {key!r:.60} of {kind}" for key in row if key not in known)
    if kind in _ATTRIBUTES:
        names = row.get("attributes", ())
        unknown = (name for name in names if not name.startswith(_ATTRIBUTES[kind]))
        yield from (f"attribute {name!r:.60} of {kind}" for name in unknown)
    if kind == "primitives":
        if row.get("mode", 4) in (0, 1, 2, 3):
            yield "points and lines"
        elif "POSITION" not in row.get("attributes", ()):
            yield "primitives without positions"
    if kind == "materials" and "occlusionTexture" in row:
        yield "occlusion maps of materials: light is traced"
    if kind == "the file" and row.get("animations"):
        yield "animations: everything stands as it does without them"
    if kind == "the file" and len(row.get("scenes", ())) > 1:
        yield f"{len(row['scenes']) - 1} of {len(row['scenes'])} scenes: the default one is read"
