"""Renders a view of a `Scene` with Blender's Cycles, from its arrays or its USD, with the cost."""

import dataclasses
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
from storage.errors import TrilightError
from storage.records.scene import ARRAY_FIELDS, Scene

_SCRIPT = Path(__file__).with_name("blender_process.py")
_USD_SCRIPT = Path(__file__).with_name("usd_process.py")
_TIMEOUT_S = 4 * 3600


@dataclass(frozen=True, kw_only=True)
class CyclesOptions:
    """Options of a render by Cycles."""

    resolution: int
    """Width and height in pixels."""
    spp: int
    """Samples per pixel; adaptive sampling is off."""
    denoise: bool
    """True to denoise by Open Image Denoise, with Cycles' albedo and normals."""
    bounces: int = 8
    """Maximum number of bounces, in sum and of each kind; 8 is Mitsuba's max_depth of 10, and 0
    direct light."""
    seed: int = 0
    """Seed of the samples, for Cycles' random numbers."""
    threads: int = 1
    """Threads of Cycles; the denoiser uses all cores of the process."""

    def with_seed(self, seed: int) -> "CyclesOptions":
        """Return these options with another seed."""
        return dataclasses.replace(self, seed=seed)


@dataclass(frozen=True, kw_only=True, eq=False)
class CyclesPicture:
    """Finished picture and its cost."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance."""
    render_s: float
    """Wall-clock seconds of sampling and denoising that Cycles states, to 10 ms, without starting
    Blender, reading the scene and building its BVH."""
    core_s: float
    """CPU seconds of that call; other work on the machine changes them less than wall-clock
    seconds."""
    prepare_s: float
    """Wall-clock seconds of the preparation: Blender's scene, and a picture of one sample."""


def cycles_picture(scene: Scene, view: int, options: CyclesOptions) -> CyclesPicture:
    """Render one view in a separate process.

    Args:
        scene: scene that passes `Scene.check`.
        view: row of the camera in the scene.
        options: options of the render.

    Raises:
        TrilightError: Blender cannot be installed (blender_environment), or it failed.
    """
    python = blender_python()
    camera = {"c2w": scene.c2w[view].tolist(), "fov_deg": float(scene.fov_deg[view])}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "scene.npz", **{field: getattr(scene, field) for field in ARRAY_FIELDS})
        request = {**dataclasses.asdict(options), **camera}
        (folder / "request.json").write_text(json.dumps(request))
        _run_blender(_SCRIPT, folder, python)
        timing = json.loads((folder / "timing.json").read_text())
        return CyclesPicture(
            radiance_rgb=np.load(folder / "picture.npy", allow_pickle=False),
            render_s=timing["render_s"],
            core_s=timing["core_s"],
            prepare_s=timing["prepare_s"],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class CyclesSamples:
    """Independent pictures of one view, and their cost."""

    pictures_rgb: tuple[NDArray[np.float32], ...]
    """[R, R, 3] linear radiance, a picture for each seed."""
    core_s: float
    """CPU seconds of all renders, without reading the file."""


def cycles_of_usd(usd: Path, options: CyclesOptions, seeds: Sequence[int]) -> CyclesSamples:
    """Render the first view of a Trilight USD file in Blender, after exact_materials.py.

    Args:
        usd: USD file, with its textures in place.
        options: options of the render; the seed is ignored.
        seeds: seed of each picture's samples.

    Raises:
        TrilightError: as `cycles_picture`.
    """
    python = blender_python()
    request = {**dataclasses.asdict(options), "usd": str(usd.resolve()), "seeds": list(seeds)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "request.json").write_text(json.dumps(request))
        _run_blender(_USD_SCRIPT, folder, python)
        picture_files = [folder / f"picture{number}.npy" for number in range(len(seeds))]
        return CyclesSamples(
            pictures_rgb=tuple(np.load(path, allow_pickle=False) for path in picture_files),
            core_s=json.loads((folder / "timing.json").read_text())["core_s"],
        )


def _run_blender(script: Path, folder: Path, python: Path) -> None:
    """Run the script; files that Blender writes by itself stay in the folder."""
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
    if result.returncode or not (folder / "timing.json").is_file():
        said = (result.stderr or result.stdout).strip().splitlines()
        raise TrilightError(
            f"Cycles: exit status {result.returncode}: {said[-1] if said else 'no message'}."
        )
