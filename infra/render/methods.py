"""Methods that render a picture: networks, traced light without a network, the path tracer.

A method loads a scene and then renders any camera. The benchmark and the leaderboard compare them.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.denoiser import Quality, denoise
from pipeline.renders.preview import PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import run_to_end
from pipeline.renders.settings import Filtered
from pipeline.renders.tracer import Features
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.config import ModelConfig
    from model.neural_renderer import NeuralRenderer

View = Callable[[NDArray[np.float32], float], NDArray[np.float32]]
"""Function that renders [R, R, 3] from camera to world [4, 4] and full field of view in degrees."""

Method = Callable[[Scene], View]
"""Function that loads a scene and returns its `View`; all pictures have one width."""

DIRECT_LIGHT = "direct light, no network"
TRACED_LIGHT = "all traced light, no network"
BUILTIN_NETWORKS = ("builtin:", "builtin:tokens")
"""Networks of every comparison: the hybrid one (more accurate), and the pure one."""

SAMPLES: tuple[tuple[int, Filtered], ...] = (
    (1, "fast"),
    (1, "high"),
    (4, "fast"),
    (4, "high"),
    (16, "fast"),
    (16, "high"),
)
"""Pairs of samples per pixel and filter of Open Image Denoise."""

KINDS = ("network", "traced light, no network", "path tracer, denoised")

SAMPLE_SEED = 20_261_122
"""Seed of the path tracer's samples; no dataset preset and no run uses it."""

_WEIGHTS = "model.safetensors"
"""Name of the weights file in the folder of a run."""


def network_name(label: str) -> str:
    """Return the name of a network's row."""
    return f"network {label}"


def network_labels(paths: Sequence[str]) -> tuple[str, ...]:
    """Return short names of networks, such as the folder of a run, without paths."""
    named = [Path(path) for path in paths]
    return tuple(path.parent.name if path.name == _WEIGHTS else path.name for path in named)


def samples_name(level: tuple[int, Filtered]) -> str:
    """Return the row's name of a number of samples with a filter."""
    return f"{level[0]} sample{'s' if level[0] > 1 else ''}, {level[1]}"


def kind_of(name: str) -> str:
    """Return the kind (one of KINDS) of a method by its row's name."""
    if name.startswith("network"):
        return KINDS[0]
    return KINDS[1] if name in (DIRECT_LIGHT, TRACED_LIGHT) else KINDS[2]


def warm_up_denoiser(resolution: int, quality: Quality = "high") -> None:
    """Create this process's denoiser for pictures of a size."""
    black = np.zeros((resolution, resolution, 3), np.float32)
    denoise(black, Features(albedo=black, normal=black), quality)


def sampled_method(resolution: int, spp: int, denoiser: Filtered) -> Method:
    """Return the path tracer with a number of samples per pixel and one denoise.

    It runs only in a render child. Samples have the same seed in every view, as those of `trilight
    render --orbit`.
    """
    settings = PreviewSettings(resolution=resolution, spp=spp, denoiser=denoiser)

    def load(scene: Scene) -> View:
        renderer = PreviewRenderer(scene, settings)
        return lambda c2w, fov_deg: (
            run_to_end(renderer.view_steps(c2w, fov_deg, SAMPLE_SEED)).radiance_rgb
        )

    return load


def network_method(renderer: "NeuralRenderer", resolution: int) -> Method:
    """Return the method that renders with a network."""

    def load(scene: Scene) -> View:
        prepared = renderer.prepare(scene)
        return lambda c2w, fov_deg: renderer.view(prepared, c2w, fov_deg, resolution)

    return load


def direct_light_method(resolution: int) -> Method:
    """Return the method that renders the direct light of lamps, as the view stage `hits` does.

    Nothing is gathered or mirrored and no network runs. Light is sampled by points on the lamps
    only, so that sharp reflections of lamps in smooth surfaces are noisy.
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
            inputs = view_inputs(
                lit, light, c2w, fov_deg, resolution,
                rays_a_side=hits_smoke().hit_rays, anchors_a_side=1, gather_rays=0,
            )  # fmt: skip
            of_lamps = inputs.pixels[..., Channel.SHOWN_DIFFUSE]
            return of_lamps + inputs.pixels[..., Channel.DIRECT_SPECULAR]

        return view

    return load


def traced_network() -> "NeuralRenderer":
    """Return an untrained network that renders the traced light of the view stage `hits`.

    Every gain is 1, nothing is added or filtered, and gathered light is weighted by the distance of
    anchors. Layers have the least possible size, so that only the tracing takes time.
    """
    import dataclasses

    from model.config import VERTEX_COORDINATES, hits_smoke

    smallest = dataclasses.replace(
        hits_smoke(), width=2 * VERTEX_COORDINATES, num_heads=1, rope_num_freqs=1,
        encoder_layers=1, decoder_layers=1, hidden_width=1, num_registers=0, pixel_width=1,
        filter_width=0, scene_tokens=False,
    )  # fmt: skip
    return untrained_network(smallest)


def untrained_network(config: "ModelConfig") -> "NeuralRenderer":
    """Return a hybrid network of any size that renders only the traced light."""
    import torch

    from model.neural_renderer import NeuralRenderer
    from model.renderformer import RenderFormer

    model = RenderFormer(config)
    model.initialize(torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.decoder.head.query.weight.zero_()
        model.decoder.head.last.bias[-6:] = -30.0  # softplus of this is 0: nothing is added
    return NeuralRenderer(model)
