"""Renders views of a `Scene` with Blender's Cycles, by way of its USD, with the cost.

Blender is under the GPL, large, and exists for one version of Python. So it is never a dependency:
a comparison installs it from the package index into the user's cache, in a separate environment,
and only a separate process imports it (infra.bench.workloads.blender_process).
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage.cache import cache_folder
from storage.errors import TrilightError
from storage.records.scene import Scene

_SCRIPT = Path(__file__).with_name("blender_process.py")
BLENDER = "4.5.15"
"""Version of Blender and of its wheel, with which the reference pictures were made."""

LOCK = Path(__file__).with_name("blender.txt")
"""Lock file of the environment, with the digests of all files (infra/setup/lock.sh)."""

PYTHON = "3.11"
"""Only version of Python that the wheel supports."""

_INSTALL_S = 1800
_RENDER_S = 4 * 3600
_PROBE = f"import bpy; assert bpy.app.version_string.startswith({BLENDER!r})"
_READY = "ready"


def render_with_cycles(
    scene: Scene,
    resolution: int,
    spp: int,
    *,
    seeds: Sequence[int] = (0,),
    views: Sequence[int] = (0,),
    denoise: bool = False,
    bounces: int = 8,
    threads: int | None = None,
) -> tuple[list[NDArray[np.float32]], float]:
    """Render pictures of a scene in a separate process.

    Args:
        resolution: width and height in pixels.
        spp: samples per pixel; adaptive sampling is off.
        seeds: of the samples, one for each picture of a view.
        views: rows of the scene's cameras.
        denoise: filter the pictures with Open Image Denoise, guided by albedo and normals.
        bounces: maximum number of bounces, in sum and of each kind; 8 is Mitsuba's max_depth of 10,
            and 0 direct light.
        threads: threads of Cycles; None for one for each core.

    Returns:
        Linear radiance [R, R, 3] for each seed of each view; and the CPU seconds of all
        renders, without reading the file and building the tree of triangles.

    Raises:
        TrilightError: Blender cannot be installed (`blender_python`), or it failed.
    """
    from pipeline.exchange.usd.write_usd import write_usd  # slow to load

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        write_usd(folder / "scene.usdc", scene)
        request = {
            "usd": str(folder / "scene.usdc"),
            "seeds": list(seeds),
            "views": list(views),
            "resolution": resolution,
            "spp": spp,
            "denoise": denoise,
            "bounces": bounces,
            "threads": threads or os.cpu_count() or 1,
        }
        (folder / "request.json").write_text(json.dumps(request))
        run_blender(_SCRIPT, folder)
        pictures = [
            np.load(folder / f"picture{number}.npy", allow_pickle=False)
            for number in range(len(seeds) * len(views))
        ]
        return pictures, json.loads((folder / "timing.json").read_text())["core_s"]


def installed_python() -> Path | None:
    """Return the Python that can import Blender, or None if it is not installed."""
    return _folder() / "bin" / "python" if (_folder() / _READY).is_file() else None


def blender_python() -> Path:
    """Return the Python that can import Blender, after installing it (380 MB) if necessary.

    Raises:
        TrilightError: there is no Python of that version, the package index lacks the wheel, or the
            wheel cannot be loaded here.
    """
    if installed := installed_python():
        return installed
    folder = _folder()
    _run("make its environment", [_base_python(), "-m", "venv", "--clear", str(folder)])
    python = folder / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--only-binary", ":all:", "--no-deps"]
    _run("install it from the package index", [*pip, "--require-hashes", "-r", str(LOCK)])
    _run("load it", [str(python), "-I", "-c", _PROBE])
    (folder / _READY).touch()  # last: an interrupted installation begins anew
    return python


def run_blender(script: Path, folder: Path) -> None:
    """Run a script with a folder as its argument in the Python of Blender.

    Files that Blender writes by itself stay in the folder.

    Raises:
        TrilightError: as `blender_python`, or the script failed.
    """
    command = [str(blender_python()), "-I", str(script), str(folder)]
    homes = {"HOME": str(folder), "BLENDER_USER_RESOURCES": str(folder)}
    _run(f"run {script.name}", command, timeout_s=_RENDER_S, **homes)


def _folder() -> Path:
    return cache_folder("cycles") / f"bpy-{BLENDER}"


def _base_python() -> str:
    """Return a Python of the wheel's version: this one, or one on the path."""
    if f"{sys.version_info.major}.{sys.version_info.minor}" == PYTHON:
        return sys.executable
    python = shutil.which(f"python{PYTHON}")
    if python is None:
        raise TrilightError(
            f"Blender {BLENDER}: python{PYTHON} is not on the path; install that version of Python."
        )
    return python


def _run(step: str, command: list[str], *, timeout_s: int = _INSTALL_S, **more: str) -> None:
    """Run a command, with more variables of the environment; raises TrilightError if it fails."""
    environment = {**os.environ, **more}
    try:
        subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=timeout_s, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        said = [type(error).__name__]
        if isinstance(error, subprocess.CalledProcessError):
            said = (error.stderr or error.stdout).strip().splitlines() or ["no message"]
        raise TrilightError(f"Blender {BLENDER}: could not {step}: {said[-1]}.") from error
