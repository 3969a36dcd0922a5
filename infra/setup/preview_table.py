"""Measures infra/render/previews.json, the table of `trilight render --seconds` and `--error`.

    python -m infra.setup.preview_table

One view of each held-out scene is rendered by the network builtin:tokens and with increasing
numbers of samples, on one thread, and the parts of a preview are timed. It takes some hours.
"""

import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from infra.render.held_out_scenes import composing_child, held_out_scene, held_out_settings
from infra.render.machine_costs import PROBES
from infra.render.methods import FILTERS, SAMPLE_SEED
from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.preview_table import (
    NETWORK_SCENE,
    NETWORK_VIEW,
    SHIPPED,
    PartCost,
    PictureCosts,
    PreviewError,
    PreviewTable,
)
from infra.render.raw_references import (
    first_camera,
    raw_reference,
    true_error_db,
)
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import SCENE, PreviewSettings, all_parts, timed_parts
from pipeline.renders.settings import Filtered
from storage.atomic import write_atomically
from storage.conventions import log10_radiance
from storage.errors import Rejected
from storage.machine import processor
from storage.records.scene import Scene
from storage.renderer import Camera, Renderer
from storage.settings.described import settings_record

if TYPE_CHECKING:
    from model.inference import NeuralRenderer

SCENES = 12
"""Number of scenes that are evaluated and timed."""

WIDTHS = {64: (1024, 2048), 128: (256, 512), 256: (64, 128), 512: (16, 128)}
"""Maximum samples of a preview, and samples of both halves of a reference, by width in pixels."""

Method = tuple[int, Filtered]
"""Samples per pixel and filter; NETWORK stands for the network builtin:tokens."""

NETWORK: Method = (0, "off")

Errors = Mapping[int, Mapping[Method, float]]
"""Error in dB of one scene's pictures, by width and method."""

Costs = Mapping[int, Mapping[str, float]]
"""CPU seconds of one scene's parts, by width and part."""

_SERIAL = (SCENE,)
"""Parts that run on one thread, however many there are."""


def main() -> None:
    """Measure, and write the file."""
    from model.inference import NeuralRenderer

    errors = dict[int, Errors]()
    costs = dict[int, Costs]()
    network = NeuralRenderer.load("builtin:tokens", device="cpu")
    with (
        tempfile.TemporaryDirectory() as name,
        contextlib.closing(
            composing_child(held_out_settings(), BENCHMARK, Path(name), threads=1)
        ) as child,
        contextlib.closing(RenderChild(choose_variant(), threads=1)) as rendering,
    ):
        renderers = {px: _renderers_at(px, network, rendering) for px in WIDTHS}
        for index in range(SCENES):
            sys.stdout.write(f"scene {index + 1} of {SCENES}\n")
            try:
                scene = held_out_scene(child, index)
            except Rejected:
                if index in PROBES:
                    raise
                continue
            errors[index] = {px: _errors_of(renderers[px], child, scene, px) for px in WIDTHS}
            costs[index] = {
                px: _costs_of(renderers[px][NETWORK], child, scene, px) for px in WIDTHS
            }
    table = table_of(errors, costs, f"{processor()}, one thread")
    text = json.dumps(settings_record(table), indent=1, sort_keys=True)
    write_atomically(SHIPPED, f"{text}\n".encode())


def ladder(px: int) -> tuple[Method, ...]:
    """Return the samples and filters that are measured at a width."""
    steps = range(WIDTHS[px][0].bit_length())
    return tuple((1 << step, each) for step in steps for each in FILTERS)


def part_names() -> tuple[str, ...]:
    """Return the names of all parts, those of the network included."""
    return (*all_parts(), NETWORK_SCENE, NETWORK_VIEW)


def table_of(
    errors: Mapping[int, Errors], costs: Mapping[int, Costs], machine: str
) -> PreviewTable:
    """Return the table of scenes by their numbers: medians, and the mean of the PROBES."""
    return PreviewTable(
        scenes=len(errors),
        errors=tuple(
            PreviewError(
                rung="network" if (spp, denoiser) == NETWORK else "traced",
                spp=spp,
                denoiser=denoiser,
                width=px,
                median_db=round(float(np.median(errors_db)), 2),
                least_db=round(min(errors_db), 2),
            )
            for px in WIDTHS
            for spp, denoiser in (NETWORK, *ladder(px))
            for errors_db in [[one[px][spp, denoiser] for one in errors.values()]]
        ),
        costs=_picture_costs(machine, list(costs.values()), np.median),
        probe=_picture_costs(machine, [costs[index] for index in PROBES], np.mean),
    )


def _errors_of(
    renderers: Mapping[Method, Renderer], child: IsolatedChild, scene: Scene, px: int
) -> dict[Method, float]:
    reference = child.call(raw_reference, scene, first_camera(scene, px), WIDTHS[px][1])
    errors = {}
    for method, renderer in renderers.items():
        image = renderer.load(scene, "scene").render(Camera.of_scene(scene, 0))
        error_db, _ = true_error_db(image.radiance_rgb, reference, log10_radiance)
        errors[method] = error_db
    return errors


def _renderers_at(
    px: int, network: "NeuralRenderer", child: RenderChild
) -> Mapping[Method, Renderer]:
    renderers: dict[Method, Renderer] = {
        NETWORK: NetworkRenderer(
            checkpoint="builtin:tokens",
            resolution=px,
            threads=1,  # core-seconds of waiting threads are not the network's
            opened=network,
        )
    }
    for spp, denoiser in ladder(px):
        settings = PreviewSettings(resolution=px, spp=spp, denoiser=denoiser)
        renderers[spp, denoiser] = PathTracer(child, settings, seed=SAMPLE_SEED)
    return renderers


def _costs_of(network: Renderer, child: IsolatedChild, scene: Scene, px: int) -> dict[str, float]:
    core_s: dict[str, float] = child.call(timed_parts, scene, px, time.process_time)
    for _ in range(2):  # the first warms up
        loaded = network.load(scene, "scene")
        view = loaded.render(Camera.of_scene(scene, 0))
        core_s[NETWORK_SCENE] = loaded.cpu_seconds or 0.0
        core_s[NETWORK_VIEW] = view.cpu_seconds or 0.0
    return core_s


def _picture_costs(
    machine: str, scenes: Sequence[Costs], over: Callable[[list[float]], np.floating]
) -> PictureCosts:
    rows = []
    for px in WIDTHS:
        for part in part_names():
            core_s = float(f"{float(over([one[px][part] for one in scenes])):.4g}")
            serial_s, parallel_s = (core_s, 0.0) if part in _SERIAL else (0.0, core_s)
            rows.append(PartCost(part=part, width=px, serial_s=serial_s, parallel_s=parallel_s))
    return PictureCosts(machine=machine, rows=tuple(rows))


if __name__ == "__main__":
    main()
