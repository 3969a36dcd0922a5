"""Process that opens a Trilight USD file in Blender and renders views of it with Cycles.

Run by path with the Python of cycles.py, which has no module of Trilight:

    python -I blender_process.py FOLDER

FOLDER/request.json holds the fields that cycles.py writes. FOLDER receives `picture<k>.npy` of each
seed of each view, float32 [R, R, 3] with the top row first, and `timing.json`.
"""

import importlib.util
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

_EXACT_MATERIALS = Path(__file__).parents[2] / "blender" / "exact_materials.py"


def main(folder: Path) -> None:
    """Render the request in the folder."""
    request = json.loads((folder / "request.json").read_text())
    open_usd(request["usd"])
    target = folder / "render.exr"
    set_up_cycles({**request, "seed": 0}, target)
    render(samples=1)  # builds the tree of triangles, which stays
    core_s = 0.0
    shots = itertools.product(request["views"], request["seeds"])
    for number, (view, seed) in enumerate(shots):
        bpy.context.scene.camera = bpy.data.objects[f"camera_{view}"]
        bpy.context.scene.cycles.seed = seed
        core_s += render(samples=request["spp"])
        np.save(folder / f"picture{number}.npy", pixels(target), allow_pickle=False)
    (folder / "timing.json").write_text(json.dumps({"core_s": core_s}))


def open_usd(path: str) -> None:
    """Import a USD file into an empty scene, with Trilight's materials and its first camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("World")  # that Blender puts a dome into
    bpy.ops.wm.usd_import(filepath=path, attr_import_mode="ALL")
    spec = importlib.util.spec_from_file_location(_EXACT_MATERIALS.stem, _EXACT_MATERIALS)
    assert spec is not None and spec.loader is not None
    exact_materials = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(exact_materials)
    exact_materials.restore_scene()
    bpy.context.scene.camera = bpy.data.objects["camera_0"]


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


def render(samples: int) -> float:
    """Render, and return the CPU seconds of the whole call."""
    bpy.context.scene.cycles.samples = samples
    bpy.context.scene.update_tag()  # or the data that stayed keep the number of samples too
    began = time.process_time()
    bpy.ops.render.render(write_still=True)
    return time.process_time() - began


def pixels(path: Path) -> NDArray[np.float32]:
    """Return the colors of an EXR file, float32 [R, R, 3], the top row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.zeros(width * height * image.channels, np.float32)
    image.pixels.foreach_get(values)
    picture: NDArray[np.float32] = values.reshape(height, width, image.channels)[::-1, :, :3]
    return np.ascontiguousarray(picture)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
