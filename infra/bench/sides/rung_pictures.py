"""One view of a scene by each rung, timed and judged: nothing traced, hits, everything."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from infra.bench.sides.judged_pictures import Reference, raw_reference, true_error_db
from infra.bench.sides.shots import SEED, warm_up_denoiser
from pipeline.renders.camera import Camera
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.preview import PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import finished
from pipeline.renders.settings import Filtered
from storage.conventions import log10_radiance
from storage.records.first_hits import first_hits
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer

REPEATS = 3
"""Counted times that each picture is made; the median counts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RungPicture:
    """A picture, and what it took once everything was warm."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3]."""
    scene_s: float
    """Core-seconds that a scene takes before its first view."""
    view_s: float
    """Core-seconds of a view."""


def sampled_rungs(
    scene: Scene, resolution: int, wanted: Sequence[tuple[int, Filtered]], reference_spp: int
) -> tuple[list[RungPicture], Reference]:
    """Return previews of the first view by samples and filter, and raw halves of it.

    Runs in a render child.
    """
    pose, fov_deg = np.asarray(scene.c2w[0], np.float64), float(scene.fov_deg[0])
    warm_up_denoiser(resolution)
    found = []
    for spp, denoiser in wanted:
        settings = PreviewSettings(resolution=resolution, spp=spp, denoiser=denoiser)
        shown: list[RungPicture] = []
        for _ in range(1 + REPEATS):
            began = time.process_time()
            renderer = PreviewRenderer(scene, settings)
            loaded = time.process_time()
            radiance = finished(renderer.view_steps(pose, fov_deg, SEED)).radiance_rgb
            shown.append(_timed(radiance, began, loaded))
        found.append(_median(shown))
    camera = Camera(c2w=pose, fov_deg=fov_deg, resolution=resolution)
    return found, raw_reference(scene, camera, reference_spp)


def network_rung(renderer: "NeuralRenderer", scene: Scene, resolution: int) -> RungPicture:
    """Return the first view by a network."""
    shown: list[RungPicture] = []
    for _ in range(1 + REPEATS):
        began = time.process_time()
        prepared = renderer.prepare(scene)
        loaded = time.process_time()
        picture = renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), resolution)
        shown.append(_timed(picture, began, loaded))
    return _median(shown)


def physics_alone() -> "NeuralRenderer":
    """Return what shows the traced light of the view stage `hits` and has learned nothing.

    Every gain is 1, nothing is added, and gathered light is mixed by how near anchors are.
    """
    import torch

    from model.config import hits_smoke
    from model.neural_renderer import NeuralRenderer
    from model.renderformer import RenderFormer

    model = RenderFormer(hits_smoke())
    model.initialise(torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.decoder.head.query.weight.zero_()
        model.decoder.head.last.bias[-6:] = -30.0  # softplus of what would be learned: nothing
    return NeuralRenderer(model)


def judged(picture: RungPicture, scene: Scene, reference: Reference) -> Mapping[str, float]:
    """Return the figures of a picture; references' noise is in none of the decibels."""
    from train.evaluation.metrics import picture_scores

    shown = picture.radiance_rgb
    hits = first_hits(scene, resolution=len(shown)).met
    everywhere = np.ones_like(hits)
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    return {
        "core_s": picture.scene_s + picture.view_s,
        "view_s": picture.view_s,
        "db": true_error_db(shown, reference, log10_radiance, everywhere)[0],
        "object_db": true_error_db(shown, reference, log10_radiance, hits)[0],
        "linear_db": true_error_db(shown, reference, clamped_radiance, everywhere)[0],
        "ssim": float(picture_scores(shown, mean.astype(np.float32), hits, None)["ssim"] or 0.0),
    }


def _timed(picture: NDArray[np.float32], began: float, loaded: float) -> RungPicture:
    return RungPicture(
        radiance_rgb=picture, scene_s=loaded - began, view_s=time.process_time() - loaded
    )


def _median(shown: Sequence[RungPicture]) -> RungPicture:
    """Return the picture with the median times of all but the first, which warms up."""
    return RungPicture(
        radiance_rgb=shown[-1].radiance_rgb,
        scene_s=float(np.median([one.scene_s for one in shown[1:]])),
        view_s=float(np.median([one.view_s for one in shown[1:]])),
    )
