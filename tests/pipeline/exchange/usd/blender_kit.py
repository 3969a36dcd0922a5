"""Blender as a process, and our picture of a scene beside its own."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.workloads.blender_environment import installed_python
from infra.bench.workloads.shots import fixed_samples, shots
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.renders.variant import activate, choose_variant
from storage.records.scene import Scene


def run_blender(process: str, folder: Path, request: dict[str, Any]) -> NDArray[np.float32]:
    """Run a script of this folder in Blender's Python; return the picture [R, R, 3] that it makes.

    Skips where Blender has not been installed: that is 380 MB, which tests do not download.
    """
    python = installed_python()
    if python is None:
        pytest.skip("Blender is not installed: run `trilight bench cycles` once")
    folder.mkdir(exist_ok=True)
    asked = {"bounces": 8, "denoise": True, "seed": 0, "threads": 2, **request}
    (folder / "request.json").write_text(json.dumps(asked))
    result = subprocess.run(
        [str(python), "-I", str(Path(__file__).with_name(process)), str(folder)],
        env={**os.environ, "HOME": str(folder), "BLENDER_USER_RESOURCES": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    picture: NDArray[np.float32] = np.load(folder / "picture.npy")
    return picture


def ours(scene: Scene, resolution: int, spp: int) -> NDArray[np.float32]:
    """Return our picture [R, R, 3] of the first view."""
    limits = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=1)
    child = IsolatedChild(limits=limits, setup=activate, setup_args=(choose_variant(),))
    try:
        settings = {"ours": fixed_samples(resolution, spp)}
        return child.call(shots, scene, settings)["ours"].view.radiance_rgb
    finally:
        child.close()
