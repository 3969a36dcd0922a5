"""Runs in Blender's own Python: does what the tutorial does with one of our scenes.

    python -I blender_usd_process.py FOLDER

FOLDER/request.json: `usd` (opened by our script), `lamp`, `material` and `color` (what is changed),
`export` (the USD file to write), and what blender_process.py takes. Receives facts.json and, of the
scene before the changes, picture.npy.
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
            "custom_normals": item.data.has_custom_normals,
            "off_center": np.abs(np.array(item.bound_box).mean(axis=0)).max(),
            "visible": item.visible_camera,
        }
        for item in bpy.data.objects
        if item.type == "MESH"
    }
    materials = {}
    for material in bpy.data.materials:
        inputs = material.node_tree.nodes["Principled BSDF"].inputs
        materials[material.name] = {
            "diffuse": list(inputs["Base Color"].default_value)[:3],
            "specular": list(inputs["Specular Tint"].default_value)[:3],
            "roughness": inputs["Roughness"].default_value,
            "emission": list(inputs["Emission Color"].default_value)[:3],
            "strength": inputs["Emission Strength"].default_value,
        }
    return {"meshes": meshes, "materials": materials}


def change(request: dict[str, Any]) -> None:
    """Move, turn and scale a lamp; color a material; make another one rough by its property."""
    lamp = bpy.data.objects[request["lamp"]]
    lamp.location.x += 0.125
    lamp.rotation_euler.z += np.pi / 2
    lamp.scale = (0.5, 0.5, 0.5)
    nodes = bpy.data.materials[request["material"]].node_tree.nodes
    nodes["Principled BSDF"].inputs["Base Color"].default_value = (*request["color"], 1.0)


def main(folder: Path) -> None:
    request = json.loads((folder / "request.json").read_text())
    cycles = module("infra/bench/workloads/blender_process.py")
    sys.argv = ["blender", "--", request["usd"]]
    module("infra/blender/exact_materials.py").main()
    (folder / "facts.json").write_text(json.dumps(facts(), default=float))
    cycles.set_up_cycles(request, folder / "render.exr")
    cycles.render(samples=request["spp"])
    np.save(folder / "picture.npy", cycles.pixels(folder / "render.exr"), allow_pickle=False)
    change(request)
    bpy.ops.wm.usd_export(filepath=request["export"])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
