"""Process that imports Blender: reads a scene, renders one view with Cycles, writes it raw.

Run by path with the Python of blender_environment.py, which has no module of Trilight:

    python -I blender_process.py FOLDER

FOLDER holds `scene.npz` (the arrays of storage.records.scene.Scene) and `request.json` (the fields
of cycles.CyclesOptions, with the camera). It receives `picture.npy`, float32 [R, R, 3] with the
top row first, and `timing.json`.

The material is what the published training pictures were rendered with: Add(Diffuse BSDF of
roughness 0, Glossy BSDF "Multiscatter GGX"), no Fresnel term. Emission is two-sided and hidden from
camera rays alone.
"""

import json
import struct
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

_CLIP_START = 1e-4
_CLIP_END = 1e4


def main(folder: Path) -> None:
    """Render the request in the folder."""
    started = time.perf_counter()
    request = json.loads((folder / "request.json").read_text())
    with np.load(folder / "scene.npz", allow_pickle=False) as arrays:
        scene = {name: arrays[name] for name in arrays.files}
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = None
    add_meshes(scene)
    add_camera(np.array(request["c2w"]), request["fov_deg"])
    target = folder / "render.exr"
    set_up_cycles(request, target)
    render(samples=1)  # builds the tree of triangles and loads the denoiser, which stay
    timing = {"prepare_s": time.perf_counter() - started, **render(samples=request["spp"])}
    header = exr_text_attributes(target)
    timing["render_s"] = _seconds(header["cycles.ViewLayer.render_time"])
    np.save(folder / "picture.npy", pixels(target), allow_pickle=False)
    (folder / "timing.json").write_text(json.dumps(timing))


def add_meshes(scene: dict[str, NDArray]) -> None:
    """Add the reflecting triangles as an object, and the emitting ones as a hidden object."""
    emits = np.any(scene["materials"][:, 7:10] > 0, axis=1)
    materials = [
        _emission(row[7:10]) if emitting else _surface(row)
        for row, emitting in zip(scene["materials"], emits, strict=True)
    ]
    triangle_emits = emits[scene["material_index"]]
    for name, chosen in (("surfaces", ~triangle_emits), ("emitters", triangle_emits)):
        if chosen.any():
            added = _add_mesh(name, scene, chosen, materials)
            # Blender's default lifts shadow rays off coarse triangles with smooth normals; 0 traces
            # the triangles as they are, as our renderer does.
            added.shadow_terminator_geometry_offset = 0.0
            added.visible_camera = name == "surfaces"


def _add_mesh(
    name: str, scene: dict[str, NDArray], chosen: NDArray[np.bool_], materials: list[Any]
) -> Any:
    """Add the chosen triangles with the shading normals of their corners."""
    corners = scene["faces"][chosen].astype(np.int64)
    count = len(corners)
    mesh = bpy.data.meshes.new(name)
    used, rows = np.unique(corners, return_inverse=True)
    mesh.vertices.add(len(used))
    mesh.vertices.foreach_set("co", scene["vertex_positions"][used].ravel())
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", rows.ravel().astype(np.int32))
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(count, np.bool_))
    for material in materials:
        mesh.materials.append(material)
    index = scene["material_index"][chosen].astype(np.int32)
    mesh.polygons.foreach_set("material_index", index)
    mesh.update(calc_edges=True)
    mesh.normals_split_custom_set_from_vertices(scene["vertex_normals"][used].tolist())
    added = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(added)
    return added


def _surface(row: NDArray[np.float32]) -> Any:
    """Return the reflecting material of one row."""
    material, nodes, output = _material("surface")
    diffuse = nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (*map(float, row[0:3]), 1.0)
    diffuse.inputs["Roughness"].default_value = 0.0
    glossy = nodes.new("ShaderNodeBsdfAnisotropic")  # what "Glossy BSDF" is called inside
    glossy.distribution = "MULTI_GGX"
    glossy.inputs["Color"].default_value = (*map(float, row[3:6]), 1.0)
    glossy.inputs["Roughness"].default_value = float(row[6])
    both = nodes.new("ShaderNodeAddShader")
    link = material.node_tree.links.new
    link(diffuse.outputs[0], both.inputs[0])
    link(glossy.outputs[0], both.inputs[1])
    link(both.outputs[0], output.inputs["Surface"])
    return material


def _emission(radiance_rgb: NDArray[np.float32]) -> Any:
    """Return a material that emits on both sides and reflects nothing."""
    material, nodes, output = _material("emitter")
    emission = nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (*map(float, radiance_rgb), 1.0)
    emission.inputs["Strength"].default_value = 1.0
    material.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    material.cycles.emission_sampling = "FRONT_BACK"
    return material


def _material(name: str) -> tuple[Any, Any, Any]:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    return material, nodes, nodes.new("ShaderNodeOutputMaterial")


def add_camera(c2w: NDArray[np.float64], fov_deg: float) -> None:
    """Add the camera; Blender's axes are those of `c2w`."""
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit = "HORIZONTAL"
    camera.angle = np.radians(fov_deg)
    camera.clip_start = _CLIP_START
    camera.clip_end = _CLIP_END
    added = bpy.data.objects.new("camera", camera)
    added.matrix_world = Matrix(c2w.tolist())  # a plain list would be taken column by column
    bpy.context.scene.collection.objects.link(added)
    bpy.context.scene.camera = added


def set_up_cycles(request: dict[str, Any], target: Path) -> None:
    """Set the options of the reference pictures; all others keep Blender's defaults."""
    scene = bpy.context.scene
    render = scene.render
    cycles = scene.cycles
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = request["resolution"]
    render.resolution_percentage = 100
    render.film_transparent = False
    render.use_persistent_data = True
    render.use_compositing = render.use_sequencer = False
    render.threads_mode = "FIXED"
    render.threads = request["threads"]
    render.filepath = str(target)
    render.use_file_extension = False
    image = render.image_settings
    image.file_format = "OPEN_EXR"
    image.color_mode = "RGB"
    image.color_depth = "32"
    image.exr_codec = "NONE"
    settings = {
        "device": "CPU",
        "seed": request["seed"],
        "use_adaptive_sampling": False,
        "use_denoising": request["denoise"],
        "denoiser": "OPENIMAGEDENOISE",
        "denoising_input_passes": "RGB_ALBEDO_NORMAL",
        "pixel_filter_type": "BOX",
        "sample_clamp_direct": 0.0,
        "sample_clamp_indirect": 0.0,
        "caustics_reflective": True,
        "caustics_refractive": True,
        "blur_glossy": 0.0,
        "light_sampling_threshold": 0.0,
        "max_bounces": request["bounces"],
        "diffuse_bounces": request["bounces"],
        "glossy_bounces": request["bounces"],
    }
    for name, value in settings.items():
        setattr(cycles, name, value)


def render(samples: int) -> dict[str, float]:
    """Render, and return the wall-clock and CPU seconds of the whole call."""
    bpy.context.scene.cycles.samples = samples
    bpy.context.scene.update_tag()  # or the data that stayed keep the number of samples too
    wall = time.perf_counter()
    cpu = time.process_time()
    bpy.ops.render.render(write_still=True)
    return {"wall_s": time.perf_counter() - wall, "core_s": time.process_time() - cpu}


def pixels(path: Path) -> NDArray[np.float32]:
    """Return the colors of an EXR file, float32 [R, R, 3], the top row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.zeros(width * height * image.channels, np.float32)
    image.pixels.foreach_get(values)
    picture: NDArray[np.float32] = values.reshape(height, width, image.channels)[::-1, :, :3]
    return np.ascontiguousarray(picture)


def exr_text_attributes(path: Path) -> dict[str, str]:
    """Return the strings in the header of an EXR file, in which Cycles states its times."""
    data = path.read_bytes()
    at = 8
    attributes = {}
    while data[at]:  # a name without letters ends the header
        name_end = data.index(0, at)
        type_end = data.index(0, name_end + 1)
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        value = data[type_end + 5 : type_end + 5 + size]
        if data[name_end + 1 : type_end] == b"string":
            attributes[data[at:name_end].decode()] = value.decode()
        at = type_end + 5 + size
    return attributes


def _seconds(clock: str) -> float:
    """Return the seconds of Blender's "minutes:seconds" or "hours:minutes:seconds"."""
    seconds = 0.0
    for part in clock.split(":"):
        seconds = 60 * seconds + float(part)
    return seconds


if __name__ == "__main__":
    main(Path(sys.argv[1]))
