"""Names of types and API schemas of prims that no code here reads."""

from collections.abc import Collection, Iterator
from typing import Any

_SILENT = (
    "|Xform|Scope|Camera|Material|Shader|NodeGraph|GeomSubset|PointInstancer|SkelRoot|Skeleton|"
    "SkelAnimation|BlendShape|Backdrop|SpatialAudio"
).split("|")
"""Types of prims that are read, or that change no shape, color or light."""

_READ = (
    "MaterialBindingAPI|SkelBindingAPI|ColorSpaceAPI|ColorSpaceDefinitionAPI|VisibilityAPI|"
    "CollectionAPI|ShapingAPI|ShadowAPI|GeomModelAPI|ModelAPI|MotionAPI|LightListAPI|ListAPI|"
    "AssetPreviewsAPI|NodeGraphNodeAPI|SceneGraphPrimAPI|AccessibilityAPI|NodeDefAPI|"
    "MaterialXConfigAPI|CoordSysAPI"
).split("|")
"""API schemas that are read, or that change no shape, color or light; each light notes its own."""

_OF_OTHERS = ("Physics", "Physx", "Semantics", "Render", "Hydra")
"""Prefixes of schemas for physics, semantics and render settings."""


def list_unread(prim: Any, time: Any, kinds: Collection[str]) -> Iterator[str]:
    """Yield names of contents of a prim that are not read, where only types `kinds` are."""
    kind = str(prim.GetTypeName())
    if not (kind in kinds or kind in _SILENT or kind.startswith(_OF_OTHERS)):
        yield kind
    for relation in prim.GetRelationships():
        if relation.GetName().startswith("material:binding"):
            targets = relation.GetForwardedTargets()
            if any(
                path.IsPrimPath() and not prim.GetStage().GetPrimAtPath(path) for path in targets
            ):
                yield "binding of a material that is not there"
    applied = prim.GetMetadata("apiSchemas")
    names = {} if applied is None else dict.fromkeys(map(str, applied.ApplyOperations([])))
    for name in dict.fromkeys(name.partition(":")[0] for name in names):
        is_read = name == "MeshLightAPI" and "RectLight" in kinds and kind == "Mesh"
        is_own = name == "LightAPI" and ("Light" in kind or "MeshLightAPI" in names)
        if not (is_read or is_own or name in _READ or name.startswith(_OF_OTHERS)):
            yield f"API schema {name}"
    mode = prim.GetAttribute("model:drawMode")
    if mode and mode.HasAuthoredValue() and mode.Get(time) not in ("default", "inherited"):
        yield f"model:drawMode {mode.Get()}"
    opacity = prim.GetAttribute("primvars:displayOpacity")
    if opacity and any(value < 1 for value in opacity.Get(time) or ()):
        yield "primvar displayOpacity"
