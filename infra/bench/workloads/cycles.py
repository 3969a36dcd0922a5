"""Renders the first view of a `Scene` with Blender's Cycles, by way of its USD, with the cost."""

import json
import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.workloads.blender_environment import blender_python
from pipeline.exchange.usd.write import write_usd
from storage.errors import TrilightError
from storage.records.scene import Scene

_SCRIPT = Path(__file__).with_name("blender_process.py")
_TIMEOUT_S = 4 * 3600


@dataclass(frozen=True, kw_only=True, eq=False)
class CyclesSamples:
    """Independent pictures of one view, and their cost."""

    pictures_rgb: tuple[NDArray[np.float32], ...]
    """[R, R, 3] linear radiance, a picture for each seed."""
    core_s: float
    """CPU seconds of all renders, without reading the file and building the tree of triangles."""


def cycles_samples(
    scene: Scene,
    resolution: int,
    spp: int,
    *,
    seeds: Sequence[int] = (0,),
    bounces: int = 8,
    threads: int | None = None,
) -> CyclesSamples:
    """Render raw pictures of a scene's first view in a separate process.

    Args:
        scene: scene that passes `Scene.check`.
        resolution: width and height in pixels.
        spp: samples per pixel; adaptive sampling is off.
        seeds: seed of each picture's samples.
        bounces: maximum number of bounces, in sum and of each kind; 8 is Mitsuba's max_depth of 10,
            and 0 direct light.
        threads: threads of Cycles; None for one for each core.

    Raises:
        TrilightError: Blender cannot be installed (blender_environment), or it failed.
    """
    python = blender_python()
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
        run_blender(_SCRIPT, folder, python)
        pictures = [folder / f"picture{number}.npy" for number in range(len(seeds))]
        return CyclesSamples(
            pictures_rgb=tuple(np.load(path, allow_pickle=False) for path in pictures),
            core_s=json.loads((folder / "timing.json").read_text())["core_s"],
        )


def run_blender(script: Path, folder: Path, python: Path) -> None:
    """Run a script in Blender's Python; files that Blender writes by itself stay in the folder.

    Raises:
        TrilightError: it failed; the message has its last line.
    """
    surroundings = {**os.environ, "HOME": str(folder), "BLENDER_USER_RESOURCES": str(folder)}
    try:
        result = subprocess.run(
            [str(python), "-I", str(script), str(folder)],
            env=surroundings,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise TrilightError(f"Cycles: no picture within {_TIMEOUT_S} s.") from error
    if result.returncode:
        said = (result.stderr or result.stdout).strip().splitlines()
        raise TrilightError(
            f"Cycles: exit status {result.returncode}: {said[-1] if said else 'no message'}."
        )
