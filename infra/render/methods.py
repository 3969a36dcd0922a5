"""Renderers that are compared: networks, traced light without a network, the path tracer."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from infra.render.networks import DirectLightRenderer, NetworkRenderer, traced_network
from infra.render.path_tracer import PathTracer, RenderChild
from pipeline.renders.preview import PreviewSettings, samples_text
from pipeline.renders.settings import Filtered
from storage.denoiser import Features, Quality, denoise
from storage.renderer import Renderer

if TYPE_CHECKING:
    from model.inference import NeuralRenderer

DIRECT_LIGHT = DirectLightRenderer.name
TRACED_LIGHT = "all traced light, no network"
BUILTIN_NETWORKS = ("builtin:", "builtin:tokens")
"""Networks of every comparison: the hybrid one (more accurate), and the pure one."""

FILTERS: tuple[Filtered, ...] = ("fast", "high")
SAMPLES = tuple((spp, each) for spp in (1, 4, 16) for each in FILTERS)
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
    return f"{samples_text(level[0])}, {level[1]}"


def kind_of(name: str) -> str:
    """Return the kind (one of KINDS) of a method by its row's name."""
    if name.startswith("network"):
        return KINDS[0]
    return KINDS[1] if name in (DIRECT_LIGHT, TRACED_LIGHT) else KINDS[2]


def warm_up_denoiser(resolution: int, quality: Quality = "high") -> None:
    """Create this process's denoiser for pictures of a size."""
    black = np.zeros((resolution, resolution, 3), np.float32)
    denoise(black, Features(albedo=black, normal=black), quality)


def compared_renderers(
    resolution: int,
    networks: "Mapping[str, NeuralRenderer]",
    child: RenderChild,
    levels: Sequence[tuple[int, Filtered]] = SAMPLES,
) -> list[Renderer]:
    """Return the renderers of a comparison at a width, named as their rows.

    Networks and traced light run on one thread of this process. Samples have the same seed in every
    view, as those of `trilight render --orbit`.

    Args:
        networks: networks by the names of their rows.
        levels: samples per pixel and filters of the previews.
    """
    compared: list[Renderer] = [DirectLightRenderer(resolution=resolution)]
    for name, network in {**networks, TRACED_LIGHT: traced_network()}.items():
        compared.append(
            NetworkRenderer(
                name=name,
                checkpoint=name,
                resolution=resolution,
                threads=1,
                opened=network,
            )
        )
    for level in levels:
        settings = PreviewSettings(resolution=resolution, spp=level[0], denoiser=level[1])
        name = samples_name(level)
        compared.append(PathTracer(child, settings, seed=SAMPLE_SEED, name=name))
    return compared
