"""Runs in Blender's own Python: the passes of Cycles for one view of a scene.

    python -I cycles_passes_process.py FOLDER

FOLDER/request.json holds what infra.bench.workloads.blender_process takes. Receives `passes.exr`:
depth, position, normal, row of the material, diffuse and specular colour, as Blender names them.
FOLDER/ours.exr, where it is there, is opened as people open passes in Blender, and what Blender
finds in it is written to `layers.json`.
"""

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import bpy

_ROOT = Path(__file__).parents[3]
_PASSES = (
    "use_pass_z",
    "use_pass_position",
    "use_pass_normal",
    "use_pass_material_index",
    "use_pass_diffuse_color",
    "use_pass_glossy_color",
)


def main(folder: Path) -> None:
    spec = importlib.util.spec_from_file_location(
        "blender_process", _ROOT / "infra/bench/workloads/blender_process.py"
    )
    assert spec is not None and spec.loader is not None
    blender: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(blender)
    request = json.loads((folder / "request.json").read_text())
    blender.open_usd(request["usd"])
    for material in bpy.data.materials:
        material.pass_index = int(material.name.rpartition("_")[2])
    target = folder / "passes.exr"
    blender.set_up_cycles(request, target)
    # the ray through the middle of each pixel, to a hundredth of its width
    bpy.context.scene.cycles.pixel_filter_type = "GAUSSIAN"
    bpy.context.scene.cycles.filter_width = 0.01
    image = bpy.context.scene.render.image_settings
    image.file_format, image.color_mode = "OPEN_EXR_MULTILAYER", "RGBA"
    layer = bpy.context.view_layer
    for use in _PASSES:
        setattr(layer, use, True)
    blender.render(samples=1)
    if (folder / "ours.exr").exists():
        (folder / "layers.json").write_text(json.dumps(_layers(folder / "ours.exr")))


def _layers(path: Path) -> dict[str, Any]:
    """Return the layers and passes that Blender finds in a file, as its image editor lists them."""
    image = bpy.data.images.load(str(path))
    scene = bpy.context.scene
    scene.use_nodes = True
    node = scene.node_tree.nodes.new("CompositorNodeImage")
    node.image = image
    return {
        "type": image.type,
        "outputs": [output.name for output in node.outputs],
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
