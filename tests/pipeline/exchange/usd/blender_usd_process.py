"""Runs in Blender's own Python: imports a USD file, says what is in it, and renders it with Cycles.

    python -I blender_usd_process.py FOLDER

FOLDER/request.json: `usd`, `exact` (whether infra/blender restores the materials), `export` (a
USD file to write from the imported scene, or null), and what blender_process.py takes.
Receives facts.json and picture.npy.
"""

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

_ROOT = Path(__file__).parents[4]


def module(path: str) -> Any:
    spec = importlib.util.spec_from_file_location(Path(path).stem, _ROOT / path)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def facts() -> dict[str, Any]:
    meshes = {
        item.name: {
            "triangles": len(item.data.polygons),
            "materials": [m.name for m in item.data.materials],
            "custom_normals": item.data.has_custom_normals,
        }
        for item in bpy.data.objects
        if item.type == "MESH"
    }
    materials = {}
    for material in bpy.data.materials:
        (node,) = (n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled")
        materials[material.name] = {
            "diffuse": list(node.inputs["Base Color"].default_value)[:3],
            "specular": list(node.inputs["Specular Tint"].default_value)[:3],
            "roughness": node.inputs["Roughness"].default_value,
            "emission": list(node.inputs["Emission Color"].default_value)[:3],
            "strength": node.inputs["Emission Strength"].default_value,
        }
    cameras = {
        item.name: {
            "fov": np.degrees(item.data.angle_x),
            "c2w": np.array(item.matrix_world).tolist(),
        }
        for item in bpy.data.objects
        if item.type == "CAMERA"
    }
    return {"meshes": meshes, "materials": materials, "cameras": cameras}


def main(folder: Path) -> None:
    request = json.loads((folder / "request.json").read_text())
    cycles = module("infra/bench/workloads/blender_process.py")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=request["usd"], attr_import_mode="ALL")
    (folder / "facts.json").write_text(json.dumps(facts()))
    if request["exact"]:
        module("infra/blender/exact_materials.py").restore_scene()
    if request["export"]:
        bpy.ops.wm.usd_export(filepath=request["export"])
    bpy.context.scene.camera = bpy.data.objects[request["camera"]]
    cycles.set_up_cycles(request, folder / "render.exr")
    cycles.render(samples=request["spp"])
    np.save(folder / "picture.npy", cycles.pixels(folder / "render.exr"), allow_pickle=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
