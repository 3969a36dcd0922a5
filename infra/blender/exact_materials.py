"""For Blender: makes an imported Trilight scene look exactly as Trilight renders it.

USD has no word for Trilight's material, so that an import shows one that is alike. The exact values
come along as custom properties `trilight:*`. Open the USD file (File > Import > Universal Scene
Description), open this file in the text editor and press Run Script; or, from the command line,

    blender --python exact_materials.py -- scene.usdz

Materials become Add(Diffuse BSDF of roughness 0, Glossy BSDF "Multiscatter GGX") without a Fresnel
term, emitters emit to both sides, reflect by their albedos, and are hidden from camera rays alone.
It needs nothing but Blender 4.2 or later.
"""

import sys
from typing import Any

import bpy

_PREFIX = "trilight:"


def restore_scene() -> tuple[int, int]:
    """Rebuild all materials and visibilities; return how many (materials, emitters) there were."""
    materials = [m for m in bpy.data.materials if f"{_PREFIX}diffuseAlbedo" in m]
    for material in materials:
        restore_material(material)
    emitters = 0
    for item in bpy.data.objects:
        visible = property_of(item, "visibleToCamera")
        if item.type == "MESH" and visible is not None:
            item.visible_camera = bool(visible)
            # Blender lifts shadow rays off coarse triangles; Trilight traces them as they are
            item.shadow_terminator_geometry_offset = 0.0
            emitters += not visible
    return len(materials), emitters


def property_of(item: Any, name: str) -> Any:
    """Return a Trilight property of an object or of its data; None where there is none."""
    for holder in (item, item.data):
        if holder is not None and _PREFIX + name in holder:
            return holder[_PREFIX + name]
    return None


def restore_material(material: Any) -> None:
    """Replace the nodes of a material by the exact ones."""
    diffuse, specular, emission = (
        (*map(float, material[_PREFIX + name]), 1.0)
        for name in ("diffuseAlbedo", "specularAlbedo", "emittedRadiance")
    )
    material.use_nodes = True
    nodes, link = material.node_tree.nodes, material.node_tree.links.new
    nodes.clear()
    lambert = nodes.new("ShaderNodeBsdfDiffuse")
    lambert.inputs["Color"].default_value = diffuse
    lambert.inputs["Roughness"].default_value = 0.0
    glossy = nodes.new("ShaderNodeBsdfAnisotropic")  # what "Glossy BSDF" is called inside
    glossy.distribution = "MULTI_GGX"
    glossy.inputs["Color"].default_value = specular
    glossy.inputs["Roughness"].default_value = float(material[_PREFIX + "roughness"])
    surface = _added(nodes, link, lambert, glossy)
    if any(emission[:3]):
        light = nodes.new("ShaderNodeEmission")
        light.inputs["Color"].default_value = emission
        light.inputs["Strength"].default_value = 1.0
        surface = _added(nodes, link, surface, light)
        material.cycles.emission_sampling = "FRONT_BACK"
    link(surface.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])


def _added(nodes: Any, link: Any, one: Any, other: Any) -> Any:
    both = nodes.new("ShaderNodeAddShader")
    link(one.outputs[0], both.inputs[0])
    link(other.outputs[0], both.inputs[1])
    return both


def main() -> None:
    """Import the file named after `--`, if there is one, and restore the scene."""
    if "--" in sys.argv[:-1]:
        bpy.ops.wm.usd_import(filepath=sys.argv[sys.argv.index("--") + 1], attr_import_mode="ALL")
    materials, emitters = restore_scene()
    print(f"Trilight: {materials} materials restored, {emitters} emitters hidden.")  # noqa: T201


if __name__ == "__main__":
    main()
