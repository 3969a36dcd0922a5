"""Process that opens a Trilight USD file in Blender, runs exact_materials.py, and renders a view.

Run by path with the Python of blender_environment.py, which has no module of Trilight:

    python -I usd_process.py FOLDER

FOLDER/request.json holds `usd` (the file), `seeds`, and the fields of cycles.CyclesOptions. It
receives `picture<k>.npy` of each seed, float32 [R, R, 3] with the top row first, and `timing.json`.
"""

import importlib.util
import json
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np

_INFRA = Path(__file__).parents[2]


def main(folder: Path) -> None:
    """Render the request in the folder."""
    request = json.loads((folder / "request.json").read_text())
    cycles = _module("bench/workloads/blender_process.py")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("World")  # that Blender puts a dome into
    bpy.ops.wm.usd_import(filepath=request["usd"], attr_import_mode="ALL")
    _module("blender/exact_materials.py").restore_scene()
    bpy.context.scene.camera = bpy.data.objects["camera_0"]
    began = time.process_time()
    for number, seed in enumerate(request["seeds"]):
        target = folder / "render.exr"
        cycles.set_up_cycles({**request, "seed": seed}, target)
        cycles.render(samples=request["spp"])
        np.save(folder / f"picture{number}.npy", cycles.pixels(target), allow_pickle=False)
    (folder / "timing.json").write_text(json.dumps({"core_s": time.process_time() - began}))


def _module(path: str) -> Any:
    spec = importlib.util.spec_from_file_location(Path(path).stem, _INFRA / path)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


if __name__ == "__main__":
    main(Path(sys.argv[1]))
