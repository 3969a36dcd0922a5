"""Pictures of a scene from Python: path traced, by a trained network, and as files."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from infra.torch_library import require_torch
from pipeline.renders.renderer import RenderedView
from pipeline.renders.settings import MOST_TRACED_SPP, StatedError, measured_settings
from storage.atomic import write_atomically
from storage.conventions import HALF_FLOAT_MAX, preview_srgb8
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.renderer import Camera

if TYPE_CHECKING:
    from model.inference import NeuralRenderer


def render(
    scene: Scene,
    *,
    view: int = 0,
    resolution: int = 256,
    noise_floor_db: float | None = None,
    noise_floor_linear_db: float | None = None,
    noise_floor_objects_db: float | None = None,
    max_spp: int = MOST_TRACED_SPP,
    stated_error: StatedError = "calibrated",
    split: bool = False,
    split_lobes: bool = False,
    seed: int = 0,
    threads: int | None = None,
) -> RenderedView:
    """Render one camera by path tracing, with the picture's measured error.

    Equal arguments give equal pictures. A child process with limits renders; each call starts one,
    so `render_views` is cheaper for several cameras.

    Args:
        scene: a scene that passes `Scene.check`.
        view: camera, a row of `scene.c2w`.
        resolution: width and height in pixels, a multiple of 8.
        noise_floor_db: sampling stops when the measured error (psnr_log_db) reaches this; by
            default 40, or none where another floor is given.
        noise_floor_linear_db: the same for psnr_linear_db; all given floors are reached.
        noise_floor_objects_db: the same for object_psnr_log_db: pixels that show geometry.
        max_spp: sampling also stops at this many samples per pixel.
        stated_error: `calibrated` for floors that are calibrated on other scenes, or `bound`.
        split: also return direct and indirect light, whose sum is the picture.
        split_lobes: also return the light of the diffuse and of the specular lobe of the visible
            surface; with `split` there are four layers.
        seed: seed of the samples.
        threads: CPU threads; all cores by default.

    Returns:
        `radiance_rgb` [R, R, 3] float32 linear radiance, its three floors, `spp` and more;
        `expected_error` where the floors are calibrated; with a split also `parts_rgb` and
        `part_floors` by name.

    Raises:
        TrilightError: an invalid number, or a scene that cannot be rendered.
    """
    (picture,) = render_views(
        scene,
        views=[view],
        resolution=resolution,
        noise_floor_db=noise_floor_db,
        noise_floor_linear_db=noise_floor_linear_db,
        noise_floor_objects_db=noise_floor_objects_db,
        max_spp=max_spp,
        stated_error=stated_error,
        split=split,
        split_lobes=split_lobes,
        seed=seed,
        threads=threads,
    )
    return picture


def render_views(
    scene: Scene,
    *,
    views: Sequence[int] | None = None,
    resolution: int = 256,
    noise_floor_db: float | None = None,
    noise_floor_linear_db: float | None = None,
    noise_floor_objects_db: float | None = None,
    max_spp: int = MOST_TRACED_SPP,
    stated_error: StatedError = "calibrated",
    split: bool = False,
    split_lobes: bool = False,
    seed: int = 0,
    threads: int | None = None,
) -> list[RenderedView]:
    """Render several cameras of a scene by path tracing; the scene is loaded once.

    Args:
        scene: a scene that passes `Scene.check`.
        views: cameras, as rows of `scene.c2w`; all by default.
        resolution, noise_floor_db, noise_floor_linear_db, noise_floor_objects_db, max_spp,
            stated_error, split, split_lobes, seed, threads: as in `render`, which documents results
            and errors.
    """
    from infra.render.path_tracer import PathTracer, RenderChild
    from pipeline.renders.mitsuba_variant import choose_variant

    rows = range(scene.num_views) if views is None else views
    cameras = [Camera.of_scene(scene, row) for row in rows]
    scene.check()
    settings = measured_settings(
        resolution,
        {
            "noise_floor_db": noise_floor_db,
            "noise_floor_linear_db": noise_floor_linear_db,
            "noise_floor_objects_db": noise_floor_objects_db,
        },
        max_spp=max_spp,
        stated_error=stated_error,
        split=split,
        split_lobes=split_lobes,
    )
    child = RenderChild(choose_variant("auto"), threads)
    tracer = PathTracer(child, settings, seed=seed)
    with contextlib.closing(tracer):
        loaded = tracer.load(scene, "scene")
        pictures = [loaded.render_view(camera) for camera in cameras]
    return cast(list[RenderedView], pictures)  # none is a preview


def open_network(
    checkpoint: str | os.PathLike[str] = "builtin:",
    *,
    device: str | None = None,
    precision: str = "float32",
) -> "NeuralRenderer":
    """Load a trained network; its `render(scene)` gives pictures [V, R, R, 3] of all cameras.

    Args:
        checkpoint: `builtin:`, the model.safetensors of a run, or RenderFormer's folder or name on
            the Hugging Face hub.
        device: PyTorch device; by default the GPU where there is one.
        precision: a name of model.precision.PRECISIONS.

    Raises:
        TrilightError: no such file, not a network, or PyTorch is not installed.
    """
    require_torch("open_network")
    from model.inference import NeuralRenderer

    return NeuralRenderer.load(os.fspath(checkpoint), device=device, precision=precision)


def write_picture(path: str | os.PathLike[str], radiance_rgb: NDArray[np.float32]) -> None:
    """Write a picture as OpenEXR (radiance in half floats) or as PNG (for looking).

    Args:
        path: file that ends in `.exr` or `.png`.
        radiance_rgb: [R, R, 3] linear radiance of at least 0; beyond 65504 it is clipped.

    Raises:
        TrilightError: another suffix, a value that is not a radiance, or a path that cannot be
            written.
    """
    from pipeline.documents.png import encode_png
    from storage.records.exr import encode_exr

    target = Path(path)
    picture = np.minimum(radiance_rgb, np.float32(HALF_FLOAT_MAX))
    if target.suffix.lower() == ".exr":
        write_atomically(target, encode_exr(picture))
    elif target.suffix.lower() == ".png":
        write_atomically(target, encode_png(preview_srgb8(picture)))
    else:
        raise TrilightError(f"{target}: cannot be written as a picture; expected .exr or .png.")
