"""Renders the first view of a `Scene` with Blender's Cycles, by way of its USD, with the cost."""

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.workloads.blender_environment import run_blender
from pipeline.exchange.usd.write import write_usd
from storage.records.scene import Scene

_SCRIPT = Path(__file__).with_name("blender_process.py")


def render_with_cycles(
    scene: Scene,
    resolution: int,
    spp: int,
    *,
    seeds: Sequence[int] = (0,),
    bounces: int = 8,
    threads: int | None = None,
) -> tuple[list[NDArray[np.float32]], float]:
    """Render raw pictures of a scene's first view in a separate process.

    Args:
        scene: scene that passes `Scene.check`.
        resolution: width and height in pixels.
        spp: samples per pixel; adaptive sampling is off.
        seeds: seed of each picture's samples.
        bounces: maximum number of bounces, in sum and of each kind; 8 is Mitsuba's max_depth of 10,
            and 0 direct light.
        threads: threads of Cycles; None for one for each core.

    Returns:
        Linear radiance [R, R, 3] for each seed; and the CPU seconds of all renders, without reading
        the file and building the tree of triangles.

    Raises:
        TrilightError: Blender cannot be installed (blender_environment), or it failed.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        write_usd(folder / "scene.usdc", scene)
        request = {
            "usd": str(folder / "scene.usdc"),
            "seeds": list(seeds),
            "resolution": resolution,
            "spp": spp,
            "denoise": False,
            "bounces": bounces,
            "threads": threads or os.cpu_count() or 1,
        }
        (folder / "request.json").write_text(json.dumps(request))
        run_blender(_SCRIPT, folder)
        pictures = [
            np.load(folder / f"picture{number}.npy", allow_pickle=False)
            for number in range(len(seeds))
        ]
        return pictures, json.loads((folder / "timing.json").read_text())["core_s"]
