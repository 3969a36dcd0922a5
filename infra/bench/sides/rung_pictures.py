"""Views of a scene by each rung: nothing traced, lamps alone, all that is traced, paths."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from infra.bench.sides.judged_pictures import Reference, true_error_db
from infra.bench.sides.shots import SEED, warm_up_denoiser
from infra.timed_views import Show, TimedViews, timed_views
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.preview import PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import finished
from pipeline.renders.settings import Filtered
from storage.conventions import log10_radiance
from storage.records.first_hits import first_hits
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.config import ModelConfig
    from model.neural_renderer import NeuralRenderer

View = Callable[[NDArray[np.float32], float], NDArray[np.float32]]
"""Makes the picture [R, R, 3] of a camera to world [4, 4] and its full field of view in degrees."""

Rung = Callable[[Scene], View]
"""Loads a scene, and returns what shows it; all pictures are of one width."""


def sampled_rung(resolution: int, spp: int, denoiser: Filtered, *, new_noise: bool = False) -> Rung:
    """Return paths of so many samples a pixel with one denoise.

    It works in a render child alone. Samples have the same seed in every view, as those of
    `trilight render --orbit`, unless the views are to have noise of their own.
    """
    settings = PreviewSettings(resolution=resolution, spp=spp, denoiser=denoiser)

    def load(scene: Scene) -> View:
        renderer = PreviewRenderer(scene, settings)
        seeds = itertools.count(SEED) if new_noise else itertools.repeat(SEED)
        return lambda c2w, fov_deg: (
            finished(renderer.view_steps(c2w, fov_deg, next(seeds))).radiance_rgb
        )

    return load


def network_rung(renderer: "NeuralRenderer", resolution: int) -> Rung:
    """Return what a network shows."""

    def load(scene: Scene) -> View:
        prepared = renderer.prepare(scene)
        return lambda c2w, fov_deg: renderer.view(prepared, c2w, fov_deg, resolution)

    return load


def lamps_rung(resolution: int) -> Rung:
    """Return the light that comes from lamps without a bounce, as the view stage `hits` traces it.

    Nothing is gathered or mirrored and no network runs. Smooth surfaces show lamps by points drawn
    on the lamps alone, so that sharp reflections of lamps are noisy.
    """
    from model.config import hits_smoke
    from model.hits.lit_scene import LitScene
    from model.hits.radiosity import SceneLight
    from model.hits.view_inputs import Channel, view_inputs
    from storage.records.material import PUBLISHED_COLUMNS, chosen_columns

    def load(scene: Scene) -> View:
        rows = chosen_columns(scene.materials, PUBLISHED_COLUMNS)[scene.material_index]
        corners, normals = (
            part[scene.faces] for part in (scene.vertex_positions, scene.vertex_normals)
        )
        lit = LitScene(corners, normals, rows)
        dark = np.zeros((2, lit.num_triangles, 3), np.float32)
        light = SceneLight(direct_2T3=dark, indirect_2T3=dark, mean_3=np.ones(3, np.float32))

        def view(c2w: NDArray[np.float32], fov_deg: float) -> NDArray[np.float32]:
            found = view_inputs(
                lit, light, c2w, fov_deg, resolution,
                rays_a_side=hits_smoke().hit_rays, anchors_a_side=1, gather_rays=0,
            )  # fmt: skip
            of_lamps = found.pixels[..., Channel.SHOWN_DIFFUSE]
            return of_lamps + found.pixels[..., Channel.DIRECT_SPECULAR]

        return view

    return load


def physics_alone() -> "NeuralRenderer":
    """Return what shows the traced light of the view stage `hits` and has learned nothing.

    Every gain is 1, nothing is added or filtered, and gathered light is mixed by how near anchors
    are. Layers
    are as small as they can be: what is timed is the tracing.
    """
    import dataclasses

    from model.config import VERTEX_COORDINATES, hits_smoke

    smallest = dataclasses.replace(
        hits_smoke(), width=2 * VERTEX_COORDINATES, num_heads=1, rope_num_freqs=1,
        encoder_layers=1, decoder_layers=1, hidden_width=1, num_registers=0, pixel_width=1,
        filter_width=0, scene_tokens=False,
    )  # fmt: skip
    return untaught(smallest)


def untaught(config: "ModelConfig") -> "NeuralRenderer":
    """Return a network of hits of any size that shows what is traced, and nothing else."""
    import torch

    from model.neural_renderer import NeuralRenderer
    from model.renderformer import RenderFormer

    model = RenderFormer(config)
    model.initialise(torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.decoder.head.query.weight.zero_()
        model.decoder.head.last.bias[-6:] = -30.0  # softplus of what would be learned: nothing
    return NeuralRenderer(model)


def timed_rung(rung: Rung, scene: Scene) -> TimedViews:
    """Return a scene's first view with its times."""

    def load() -> Show:
        view = rung(scene)
        return lambda: view(scene.c2w[0], float(scene.fov_deg[0]))

    return timed_views(load)


def timed_samples(
    scene: Scene, resolution: int, wanted: Sequence[tuple[int, Filtered]]
) -> list[TimedViews]:
    """Return the first view by samples a pixel and filter; runs in a render child."""
    warm_up_denoiser(resolution)
    return [timed_rung(sampled_rung(resolution, spp, filtered), scene) for spp, filtered in wanted]


def judged(picture: TimedViews, scene: Scene, reference: Reference) -> Mapping[str, float]:
    """Return the figures of a picture; references' noise is in none of the decibels."""
    from train.evaluation.metrics import picture_scores

    shown = picture.radiance_rgb
    hits = first_hits(scene, resolution=len(shown)).met
    everywhere = np.ones_like(hits)
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    return {
        "core_s": picture.first_s,
        "view_s": picture.further_s,
        "db": true_error_db(shown, reference, log10_radiance, everywhere)[0],
        "object_db": true_error_db(shown, reference, log10_radiance, hits)[0],
        "linear_db": true_error_db(shown, reference, clamped_radiance, everywhere)[0],
        "ssim": float(picture_scores(shown, mean.astype(np.float32), hits, None)["ssim"] or 0.0),
    }
