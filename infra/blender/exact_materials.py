"""For Blender: makes an imported Trilight scene look exactly as Trilight renders it.

USD has no word for Trilight's material, so that an import shows one that is alike. The exact values
come along as custom properties `trilight:*`. Open the USD file (File > Import > Universal Scene
Description), open this file in the text editor and press Run Script; or, from the command line,

    blender --python exact_materials.py -- scene.usdz

Materials become Add(Diffuse BSDF of roughness 0, Glossy BSDF "Multiscatter GGX") without a Fresnel
term, emitters emit to both sides, reflect by their albedos, and are hidden from camera rays alone.
Textures stay connected, and are interpolated between linear values instead of encoded ones. A sky
is turned as the scene says, and seen by cameras only where it is there. (Blender imports a sky into
the world of its scene; this needs one.) It needs nothing but Blender 4.2 or later.
"""

import sys
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

_PREFIX = "trilight:"

_COLUMNS = {
    ("ShaderNodeBsdfPrincipled", "Base Color"): "diffuse",
    ("ShaderNodeBsdfPrincipled", "Specular Tint"): "specular",
    ("ShaderNodeBsdfPrincipled", "Roughness"): "roughness",
    ("ShaderNodeBsdfDiffuse", "Color"): "diffuse",
    ("ShaderNodeBsdfAnisotropic", "Color"): "specular",
    ("ShaderNodeBsdfAnisotropic", "Roughness"): "roughness",
}
"""What an input of an imported material, or of one that was restored before, stands for."""

_REPLACED = {node for node, _ in _COLUMNS} | {
    "ShaderNodeAddShader",
    "ShaderNodeEmission",
    "ShaderNodeOutputMaterial",
}


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
    for image in list(bpy.data.images):
        interpolate_linear_values(image)
    if materials:
        restore_sky()
    return len(materials), emitters


def restore_sky() -> None:
    """Turn the world's picture as the scene says, and hide it from cameras where it is not seen.

    A scene without a sky has no world: the one that Blender begins with is grey, and lights it.
    """
    world = bpy.context.scene.world
    marked = [item for item in bpy.data.objects if f"{_PREFIX}skyVisibleToCamera" in item]
    if world is None or not marked:
        bpy.context.scene.world = None
        return
    world.cycles_visibility.camera = bool(marked[0][f"{_PREFIX}skyVisibleToCamera"])
    rows = np.array([list(marked[0][f"{_PREFIX}skyRotationRow{row}"]) for row in range(3)])
    for node in world.node_tree.nodes:
        if node.bl_idname == "ShaderNodeMapping":  # of directions of the world to those of the map
            node.vector_type = "POINT"
            node.inputs["Rotation"].default_value = Matrix(rows.T.tolist()).to_euler("XYZ")


def interpolate_linear_values(image: Any) -> None:
    """Let a texture hold linear values: Cycles decodes sRGB after it has interpolated."""
    if image.is_float or image.colorspace_settings.name != "sRGB" or not image.size[0]:
        return
    encoded = np.zeros(image.size[0] * image.size[1] * image.channels, np.float32)
    image.pixels.foreach_get(encoded)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    held = bpy.data.images.new(f"{image.name} linear", *image.size, float_buffer=True, is_data=True)
    held.pixels.foreach_set(linear.astype(np.float32))
    held.pack()
    image.user_remap(held)


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
    textures = {}
    for known in material.node_tree.links:
        column = _COLUMNS.get((known.to_node.bl_idname, known.to_socket.name))
        if column is not None:
            textures[column] = known.from_socket
    for node in [node for node in nodes if node.bl_idname in _REPLACED]:
        nodes.remove(node)
    lambert = nodes.new("ShaderNodeBsdfDiffuse")
    lambert.inputs["Color"].default_value = diffuse
    lambert.inputs["Roughness"].default_value = 0.0
    glossy = nodes.new("ShaderNodeBsdfAnisotropic")  # what "Glossy BSDF" is called inside
    glossy.distribution = "MULTI_GGX"
    glossy.inputs["Color"].default_value = specular
    glossy.inputs["Roughness"].default_value = float(material[_PREFIX + "roughness"])
    sockets = {
        "diffuse": lambert.inputs["Color"],
        "specular": glossy.inputs["Color"],
        "roughness": glossy.inputs["Roughness"],
    }
    for column, source in textures.items():
        link(source, sockets[column])
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
        if bpy.context.scene.world is None:
            bpy.context.scene.world = bpy.data.worlds.new("World")
        bpy.ops.wm.usd_import(filepath=sys.argv[sys.argv.index("--") + 1], attr_import_mode="ALL")
    materials, emitters = restore_scene()
    print(f"Trilight: {materials} materials restored, {emitters} emitters hidden.")  # noqa: T201


if __name__ == "__main__":
    main()
