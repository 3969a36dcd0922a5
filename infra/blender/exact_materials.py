"""Blender script that makes an imported Trilight scene look exactly as Trilight renders it.

USD cannot express Trilight's material, so that an import shows a similar one: its gloss takes light
from the layer below, and lamps are visible. Open the USD file (File > Import > Universal Scene
Description), open this file in the text editor and press Run Script; or, from the command line,

    blender --python exact_materials.py -- scene.usdz

A material becomes Add(Principled BSDF without gloss, Glossy BSDF "Multiscatter GGX"), which has no
Fresnel term. The Principled BSDF stays the one that users edit and that Blender exports: the gloss
follows its roughness and its specular tint. Emitters are hidden from camera rays only. Textures are
interpolated between linear values instead of encoded ones. A sky is rotated as in the scene, and is
visible to cameras only if the scene says so. (Blender imports a sky into the world of its scene,
which must exist.) The script needs only Blender 4.2 or later.
"""

import sys
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

_PREFIX = "trilight:"
_VISIBLE = f"{_PREFIX}visibleToCamera"
"""Property of an emitter, on the object or on its data."""

_GLOSS = "Trilight gloss"
_SUM = "Trilight sum"
_LINEAR = "Trilight linear"
"""Names of the nodes that are added to a restored material; the last is a prefix."""


def restore_scene() -> tuple[int, int]:
    """Rebuild all materials and visibilities; return how many (materials, emitters) there were."""
    materials = [m for m in bpy.data.materials if f"{_PREFIX}diffuseAlbedo" in m]
    for material in materials:
        restore_material(material)
    emitters = 0
    for item in bpy.data.objects:
        marked = [each for each in (item, item.data) if each is not None and _VISIBLE in each]
        if item.type == "MESH" and marked:
            visible = bool(marked[0][_VISIBLE])
            item.visible_camera = visible
            # Blender lifts shadow rays off coarse triangles; Trilight traces them as they are
            item.shadow_terminator_geometry_offset = 0.0
            emitters += not visible
    if materials:
        restore_sky()
        restore_view()
    return len(materials), emitters


def restore_sky() -> None:
    """Rotate the world's picture as in the scene, and hide it from cameras if the scene says so.

    A scene without a sky gets no world: Blender's default one is gray, and would light it.
    """
    world = bpy.context.scene.world
    marked = [item for item in bpy.data.objects if f"{_PREFIX}skyVisibleToCamera" in item]
    if world is None or not marked:
        nodes = world.node_tree.nodes if world is not None and world.node_tree else []
        if not any(node.bl_idname == "ShaderNodeTexEnvironment" for node in nodes):
            bpy.context.scene.world = None
        return
    world.cycles_visibility.camera = bool(marked[0][f"{_PREFIX}skyVisibleToCamera"])
    rows = np.array([list(marked[0][f"{_PREFIX}skyRotationRow{row}"]) for row in range(3)])
    for node in world.node_tree.nodes:
        if node.bl_idname == "ShaderNodeMapping":  # maps directions of the world to the map's
            node.vector_type = "POINT"
            node.inputs["Rotation"].default_value = Matrix(rows.T.tolist()).to_euler("XYZ")


def restore_view() -> None:
    """Select Cycles, and if no camera is chosen yet, the first camera with square pictures."""
    scene = bpy.context.scene
    first = bpy.data.objects.get("camera_0")
    scene.render.engine = "CYCLES"
    if first is not None and scene.camera in (None, first):
        scene.camera = first
        scene.render.resolution_y = scene.render.resolution_x


def interpolate_linear_values(image: Any) -> Any:
    """Return a copy of a texture with linear values, since Cycles decodes sRGB after interpolation.

    None if the texture holds linear values already.
    """
    if image.is_float or image.colorspace_settings.name != "sRGB" or not image.size[0]:
        return None
    if f"{image.name} linear" in bpy.data.images:
        return bpy.data.images[f"{image.name} linear"]
    encoded = np.zeros(image.size[0] * image.size[1] * image.channels, np.float32)
    image.pixels.foreach_get(encoded)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    held = bpy.data.images.new(f"{image.name} linear", *image.size, float_buffer=True, is_data=True)
    held.pixels.foreach_set(linear.astype(np.float32))
    held.pack()
    return held


def restore_material(material: Any) -> None:
    """Move the gloss of a material from its Principled BSDF into a separate shader."""
    nodes = material.node_tree.nodes
    link = material.node_tree.links.new
    base = next((n for n in nodes if n.bl_idname == "ShaderNodeBsdfPrincipled"), None)
    if base is None or _GLOSS in nodes:
        return
    for node in [node for node in nodes if node.bl_idname == "ShaderNodeTexImage" and node.image]:
        show_linear_values(material.node_tree, node)
    gloss = nodes.new("ShaderNodeBsdfAnisotropic")  # internal name of "Glossy BSDF"
    gloss.name = gloss.label = _GLOSS
    gloss.distribution = "MULTI_GGX"
    follow(material, "specularAlbedo", base.inputs["Specular Tint"], gloss.inputs["Color"])
    follow(material, "roughness", base.inputs["Roughness"], gloss.inputs["Roughness"])
    for known in base.inputs["Normal"].links:  # of a normal map
        link(known.from_socket, gloss.inputs["Normal"])
    base.inputs["Specular IOR Level"].default_value = 0.0
    both = nodes.new("ShaderNodeAddShader")
    both.name = _SUM
    link(base.outputs[0], both.inputs[0])
    link(gloss.outputs[0], both.inputs[1])
    output = next(node for node in nodes if node.bl_idname == "ShaderNodeOutputMaterial")
    link(both.outputs[0], output.inputs["Surface"])
    material.cycles.emission_sampling = "FRONT_BACK"


def follow(material: Any, name: str, base: Any, gloss: Any) -> None:
    """Connect an input of the gloss to the texture of its base, or drive both by a property.

    Users then edit the property, and Blender exports it.
    """
    if base.is_linked:
        material.node_tree.links.new(base.links[0].from_socket, gloss)
        return
    is_color = base.type == "RGBA"
    value = list(base.default_value)[:3] if is_color else base.default_value
    if not np.allclose(value, material[_PREFIX + name], rtol=1e-6):  # edited before this script
        material[_PREFIX + name] = value
    for socket in (base, gloss):
        curves = socket.driver_add("default_value")
        for channel, curve in enumerate(curves[:3] if is_color else [curves]):
            curve.driver.type = "AVERAGE"
            target = curve.driver.variables.new().targets[0]
            target.id_type = "MATERIAL"
            target.id = material
            part = f"[{channel}]" if is_color else ""
            target.data_path = f'["{_PREFIX}{name}"]{part}'


def show_linear_values(tree: Any, node: Any) -> None:
    """Show a copy of a texture with linear values; the original is still the exported one."""
    held = interpolate_linear_values(node.image)
    if held is None:
        return
    linear_node = tree.nodes.new("ShaderNodeTexImage")
    linear_node.name = f"{_LINEAR} {node.name}"
    linear_node.image = held
    linear_node.extension = node.extension
    for known in node.inputs["Vector"].links:
        tree.links.new(known.from_socket, linear_node.inputs["Vector"])
    chosen = tree.nodes.new("ShaderNodeMix")  # Blender exports the first texture that it finds
    chosen.data_type = "RGBA"
    factor, first, second = (chosen.inputs[n] for n in (0, 6, 7))
    factor.default_value = 1.0
    targets = [known.to_socket for known in node.outputs["Color"].links]
    tree.links.new(node.outputs["Color"], first)
    tree.links.new(linear_node.outputs["Color"], second)
    for target in targets:
        tree.links.new(chosen.outputs[2], target)


def main() -> None:
    """Import the file named after `--`, if there is one, and restore the scene."""
    if "--" in sys.argv[:-1]:
        bpy.ops.wm.read_homefile(use_empty=True)
        if bpy.context.scene.world is None:
            bpy.context.scene.world = bpy.data.worlds.new("World")
        bpy.ops.wm.usd_import(filepath=sys.argv[sys.argv.index("--") + 1], attr_import_mode="ALL")
    materials, emitters = restore_scene()
    print(f"Trilight: {materials} materials restored, {emitters} emitters hidden.")  # noqa: T201


if __name__ == "__main__":
    main()
