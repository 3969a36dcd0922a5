"""Runs in Blender's own Python: opens one of our scenes or makes one, renders it, exports as USD.

    python -I blender_process.py FOLDER

FOLDER/request.json holds what infra.bench.workloads.blender_process takes; picture.npy is received.

With `usd` it does what the tutorial does with one of our scenes: our script opens that file, the
picture is taken, then `lamp`, `material` and `color` say what is changed, and `export` the USD file
to write. Receives facts.json.

Without, it makes what Blender's users make: a grid of quads with a picture on it, a cylinder of
n-gons, smooth quads, a collection that stands twice, a metal, and a rectangle that lights. Receives
scene.usdc and, with instances instead of copies, instances.usdc; and their textures.
"""

import importlib.util
import json
import math
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

_ROOT = Path(__file__).parents[4]
_CELLS, _TEXELS = 16, 64


def module(path: str) -> Any:
    spec = importlib.util.spec_from_file_location(Path(path).stem, _ROOT / path)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def principled(name: str, colour: tuple[float, float, float], **inputs: float) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    node = material.node_tree.nodes["Principled BSDF"]
    node.inputs["Base Color"].default_value = (*colour, 1.0)
    for label, value in inputs.items():
        node.inputs[label.replace("_", " ").title()].default_value = value
    return material


def add_picture(material: Any, path: Path) -> None:
    """Colour a material by a picture that changes slowly, as a wall's paint does."""
    at = (np.arange(_TEXELS) + 0.5) / _TEXELS
    encoded = np.ones((_TEXELS, _TEXELS, 4), np.float32)
    encoded[..., 0] = 0.5 + 0.4 * np.cos(2 * np.pi * at)[None]
    encoded[..., 1] = 0.5 + 0.4 * np.cos(2 * np.pi * at)[:, None]
    encoded[..., 2] = 0.4
    image = bpy.data.images.new(path.stem, _TEXELS, _TEXELS)
    image.pixels.foreach_set(encoded.ravel())
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    nodes, links = material.node_tree.nodes, material.node_tree.links
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = bpy.data.images.load(str(path))
    links.new(texture.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])


def last(material: Any, smooth: bool = False) -> Any:
    """Dress the object that was added last."""
    added = bpy.context.object
    added.data.materials.append(material)
    added.data.shade_smooth() if smooth else added.data.shade_flat()
    added.shadow_terminator_geometry_offset = 0.0
    return added


def make_scene(folder: Path) -> None:
    matt = {"roughness": 0.7}
    floor = principled("floor", (0.5, 0.5, 0.5), **matt)
    add_picture(floor, folder / "paint.png")
    mesh = bpy.ops.mesh
    mesh.primitive_grid_add(x_subdivisions=_CELLS, y_subdivisions=_CELLS, size=2)
    last(floor)
    mesh.primitive_plane_add(size=2, location=(0, 1, 1), rotation=(math.pi / 2, 0, 0))
    last(principled("wall", (0.7, 0.65, 0.6), **matt))
    mesh.primitive_cylinder_add(vertices=12, radius=0.25, depth=0.5, location=(-0.5, 0.1, 0.25))
    last(principled("red", (0.6, 0.1, 0.08), **matt))
    mesh.primitive_uv_sphere_add(segments=24, ring_count=12, radius=0.3, location=(0.3, 0.3, 0.3))
    last(principled("metal", (0.8, 0.6, 0.3), metallic=1.0, roughness=0.4), smooth=True)
    mesh.primitive_monkey_add(size=0.4, location=(0.0, -0.45, 0.22), rotation=(-0.5, 0, 0.4))
    head = last(principled("blue", (0.1, 0.2, 0.6), **matt))
    heads = bpy.data.collections.new("heads")
    heads.objects.link(head)
    again = bpy.data.objects.new("again", None)  # an instance of the whole collection
    again.instance_type, again.instance_collection = "COLLECTION", heads
    again.location, again.scale = (0.6, 0.0, 0.0), (1.0, 1.0, 1.4)
    bpy.context.collection.objects.link(again)
    bpy.ops.object.light_add(type="AREA", location=(-0.4, -0.5, 2.2), rotation=(0.2, -0.15, 0))
    lamp = bpy.context.object
    lamp.data.shape, lamp.data.size, lamp.data.size_y = "RECTANGLE", 0.8, 0.5
    lamp.data.energy, lamp.data.color = 60.0, (1.0, 0.9, 0.8)
    bpy.ops.object.camera_add(location=(1.1, -2.9, 1.5), rotation=(math.radians(69), 0, 0.36))
    bpy.context.scene.camera = bpy.context.object
    bpy.context.object.data.angle = math.radians(42)


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
    if "usd" in request:
        sys.argv = ["blender", "--", request["usd"]]
        module("infra/blender/exact_materials.py").main()
        (folder / "facts.json").write_text(json.dumps(facts(), default=float))
    else:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        make_scene(folder)
        for name, instances in (("scene", False), ("instances", True)):
            bpy.ops.wm.usd_export(filepath=str(folder / f"{name}.usdc"), use_instancing=instances)
    cycles.set_up_cycles(request, folder / "render.exr")
    cycles.render(samples=request["spp"])
    np.save(folder / "picture.npy", cycles.pixels(folder / "render.exr"), allow_pickle=False)
    if "usd" in request:
        change(request)
        bpy.ops.wm.usd_export(filepath=request["export"])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
