"""Run as a process of its own: renders a small picture with a variant, to try or to time it.

Its argument is the name of a variant that is tried, or a whole `Variant`, whose facts are printed.
LLVM's library of a trial is the one of the environment. It ends with status 0 only when the picture
is the right one (PROBE_PICTURE) within its noise. The scene needs every kind of ray: it has a
lamp beside the view, a glossy wall that reflects light, and a screen that hides and shades what is
behind it. Where a kernel misses one kind of hit, some block of the picture is wrong.

On a GPU it then prints why pictures cannot be denoised there, if so.
"""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.isolation import die_with_parent
from pipeline.renders.mitsuba_variant import PROBE_PICTURE, Variant, activate, run_probe
from storage.conventions import look_at_c2w
from storage.denoiser import DenoiserDevice, gpu_is_supported, open_device, set_denoiser_device
from storage.installation import child_environment
from storage.records.material import completed_rows
from storage.records.scene import ObjectKind, Scene, SceneObject

if TYPE_CHECKING:
    from pipeline.renders.renderer import RenderedView

BLOCK = 4
"""Width in pixels of the blocks whose means are compared: a few bright samples decide a pixel."""

_numbers = np.array(PROBE_PICTURE.split(), np.float64).reshape(4, 4, 2, 3)
MEAN_RGB = _numbers[:, :, 0]
DEVIATION_RGB = _numbers[:, :, 1]

_MOST_DEVIATIONS = 6
"""Standard deviations by which a right picture is off, somewhere, once in ten million probes."""

_DENOISER_TOLERANCE = 0.02
"""Tolerance relative to a block's mean: GPUs compute in half floats, which are exact to 0.0005,
through many layers; a picture that a GPU gets wrong is off by far more."""

_DEVICES: tuple[DenoiserDevice, ...] = ("CPU", "CUDA")

_FACTS_S = 120

VIEW_PX = 256
"""Width of the picture that is timed, pixels."""
VIEW_SPP = 128
"""Its samples per pixel."""


def main() -> None:
    die_with_parent()
    name = sys.argv[1]
    if name.startswith("{"):
        sys.stdout.write(json.dumps(_measure_facts(Variant(**json.loads(name)))))
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # an abort is an answer, not an accident
    import drjit
    import mitsuba

    mitsuba.set_variant(name)
    drjit.set_log_level(drjit.LogLevel.Warn)  # of rays that it leaves out, Dr.Jit says no more
    if wrong := wrong_picture():
        raise SystemExit(wrong)
    if name == "cuda_ad_rgb":
        sys.stdout.write(denoiser_problem())


def render_facts(variant: Variant) -> dict[str, str]:
    """Return the denoiser, threads and seconds of a view by name; empty if unknown in time."""
    try:
        result = run_probe(json.dumps(vars(variant)), _FACTS_S, child_environment())
    except subprocess.TimeoutExpired:  # a busy machine
        return {}
    return dict(json.loads(result.stdout)) if result.returncode == 0 else {}


def _measure_facts(variant: Variant) -> dict[str, str]:
    activate(variant)
    import drjit

    version = open_device(variant.denoiser).get_int("version")
    render_view = load_probe(VIEW_PX, VIEW_SPP)
    seconds = []
    for seed in range(3):  # the first one compiles kernels
        began = time.perf_counter()
        render_view(seed)
        seconds.append(time.perf_counter() - began)
    return {
        "threads": str(drjit.thread_count()),
        "denoiser": f"{version // 10000}.{version // 100 % 100}.{version % 100}",
        "denoiser_device": variant.denoiser,
        "view_s": f"{min(seconds):.2g}",
    }


def wrong_picture() -> str:
    """Return what is wrong with the picture that is rendered here, or nothing."""
    blocks, all_hit = probe_blocks(seed=0)
    if not all_hit:
        return "rays of the camera miss the scene"
    deviations = np.abs(blocks - MEAN_RGB) / DEVIATION_RGB
    if (deviations < _MOST_DEVIATIONS).all():  # a comparison that no NaN passes
        return ""
    row, column, channel = np.unravel_index(np.argmax(deviations), deviations.shape)
    return (
        f"a wrong picture: block {row}, {column} has a {'RGB'[channel]} of "
        f"{blocks[row, column, channel]:.4g}; expected {MEAN_RGB[row, column, channel]:.4g} with a "
        f"standard deviation of {DEVIATION_RGB[row, column, channel]:.2g}"
    )


def denoiser_problem() -> str:
    """Return why pictures cannot be denoised on the graphics card, or nothing."""
    if not gpu_is_supported():
        return "Open Image Denoise does not support the graphics card"
    blocks = []
    for device in _DEVICES:
        set_denoiser_device(device)
        try:
            blocks.append(probe_blocks(seed=0, denoiser="high")[0])
        except RuntimeError as error:
            return f"{error} (on {device})"
    on_cpu, on_gpu = blocks
    if (np.abs(on_gpu - on_cpu) < _DENOISER_TOLERANCE * on_cpu).all():
        return ""
    return "Open Image Denoise gives another picture on the graphics card"


def probe_blocks(
    seed: int, denoiser: Literal["high", "off"] = "off"
) -> tuple[NDArray[np.float64], bool]:
    """Return the means [4, 4, 3] of the picture's blocks, and whether all pixels see the scene."""
    view = load_probe(4 * BLOCK, 512, denoiser)(seed)
    cells = view.radiance_rgb.astype(np.float64).reshape(4, BLOCK, 4, BLOCK, 3)
    return cells.mean(axis=(1, 3)), bool(view.hits.all())


def load_probe(
    resolution: int, spp: int, denoiser: Literal["high", "off"] = "high"
) -> "Callable[[int], RenderedView]":
    """Load the probe's scene; return what renders its view with a seed."""
    from pipeline.renders.renderer import SceneRenderer
    from pipeline.renders.settings import RenderSettings

    scene = probe_scene()
    settings = RenderSettings(
        resolution=resolution,
        noise_floor_db=90,
        min_spp=spp,
        max_spp=spp,
        denoiser=denoiser,
        min_mean_radiance=0,
        arithmetic="device",
    )
    renderer = SceneRenderer(scene, settings)
    return partial(renderer.render_view, scene.c2w[0], float(scene.fov_deg[0]))


def probe_scene() -> Scene:
    """Return a floor, a glossy wall behind it, a screen in front of both, and a lamp above."""
    parts = [
        _quad([-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]),
        _quad([-3, 1, 0], [3, 1, 0], [3, 1, 5], [-3, 1, 5]),
        _quad([-0.2, -0.6, 0], [0.9, -0.6, 0], [0.9, -0.6, 0.8], [-0.2, -0.6, 0.8]),
        np.array([[[-0.6, -1.2, 1.9], [0.2, -1.2, 1.9], [-0.2, -0.8, 2.2]]]),
    ]
    kinds: tuple[ObjectKind, ...] = ("shell", "shell", "object", "emitter")
    rows = np.repeat(np.arange(4), [len(part) for part in parts]).astype(np.uint16)
    corners = np.concatenate(parts)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    materials = [
        [0.7, 0.6, 0.5, 0, 0, 0, 1, 0, 0, 0],
        [0.05, 0.05, 0.05, 0.8, 0.7, 0.5, 0.3, 0, 0, 0],
        [0.1, 0.3, 0.1, 0, 0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 1, 12, 10, 8],
    ]
    return Scene(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        vertex_normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        faces=np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3),
        material_index=rows,
        materials=completed_rows(np.array(materials, np.float32), None),
        object_index=rows,
        c2w=look_at_c2w(eye=[0, -3, 1.6], target=[0.1, 0, 0.4], up=[0, 0, 1])[None].astype(
            np.float32
        ),
        fov_deg=np.array([40], np.float32),
        objects=tuple(
            SceneObject(name=f"{kind} {row}", kind=kind) for row, kind in enumerate(kinds)
        ),
        provenance={},
    )


def _quad(*ring: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(ring, np.float64)[np.array([[0, 1, 2], [0, 2, 3]])]


if __name__ == "__main__":
    main()
