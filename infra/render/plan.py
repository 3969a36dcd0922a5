"""Plan of one call of `trilight render`: all decisions, before any picture is rendered."""

import dataclasses
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from infra.render.networks import NetworkRenderer
from infra.render.options import EngineChoice, RenderOptions
from infra.render.output_paths import OutputPaths, output_paths
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.preview_table import Choice, choose, known_costs, price_all, shipped_table
from infra.render.quality import Budget, FixedSamples, Traced
from infra.render.sources import camera_path, orbit, own_camera, pair_cameras, scene_sources
from infra.render.tone_mapping import Look
from infra.torch_library import require_torch
from pipeline.exchange.open_scene import SceneSource, scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.renders.mitsuba_variant import choose_variant
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.renderer import Camera, Renderer

Pairs = Sequence[tuple[SceneSource, Camera | int]]
"""Scene and camera of each picture; a number is the row of a camera of the scene."""

_RESOLUTION = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One picture to render."""

    source: SceneSource
    camera: Camera | int
    """Camera, or the row of a camera of the scene."""
    exrs: Mapping[str, Path]
    """Paths of the EXR files by the name of their renderer."""
    png: Path
    keep: bool
    """True to keep existing files of an equal picture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderPlan:
    """Pictures, renderers and files of a render, with all defaults resolved."""

    source: str
    """Scene or scenes as the user named them."""
    view: int
    """Row of the scene's camera that the user named."""
    engine: EngineChoice
    """Value of `--engine`, or the engine that --seconds or --error chose."""
    renderers: Sequence[Renderer]
    """One renderer, or the path tracer and the network."""
    resolution: int
    """Width of every picture in pixels."""
    look: Look
    output: OutputPaths
    shots: Sequence[Shot]
    """Pictures in order; those of one scene are consecutive."""
    fps: int
    choice: Choice | None = None
    """Samples or network for a budget, with their expected cost and error; None without one."""


def plan_render(options: RenderOptions, reader: SceneReader) -> RenderPlan:
    """Return the plan of a render, and make the folder of its files.

    Raises:
        TrilightError: an option without effect, an unusable source, camera or checkpoint, or a
            folder that cannot be written.
    """
    checkpoint, resolution = _network_and_width(options)
    quality = options.quality
    choice = None
    FixedSamples(spp=1, denoiser="off").settings(resolution)  # reports a wrong width first
    renderers = []
    if not isinstance(quality, Budget):
        renderers = _renderers(options, quality, checkpoint, resolution)
    look = Look(tone_map=options.tone_map, exposure_ev=options.exposure_ev)
    if options.out.suffix.lower() == ".exr":
        scene_source(options.source)  # reports a wrong name before any library is loaded
    output = output_paths(options.out)
    pairs = _pairs(options, reader, output)
    if isinstance(quality, Budget):
        choice = _choose(quality, pairs, resolution, options.threads)
        renderers = _renderers(options, choice.priced.samples, None, resolution)
    return RenderPlan(
        source=options.source,
        view=options.view,
        engine=options.engine if choice is None else choice.engine,
        renderers=renderers,
        resolution=resolution,
        look=look,
        output=output,
        shots=list(shots(pairs, output, [renderer.name for renderer in renderers])),
        fps=options.fps,
        choice=choice,
    )


def shots(pairs: Pairs, output: OutputPaths, names: list[str]) -> Iterator[Shot]:
    """Yield the shot of each pair, with its files by the names of renderers."""
    for index, (source, camera) in enumerate(pairs):
        stem = output.stem_of(index)
        suffixes = {name: f".{name}.exr" if len(names) > 1 else ".exr" for name in names}
        exrs = {name: Path(f"{stem}{suffix}") for name, suffix in suffixes.items()}
        png = Path(f"{stem}.png")
        if isinstance(camera, Camera):  # of an orbit or a file: the scene has no such row
            camera = dataclasses.replace(camera, view=None, name=f"picture {png.stem}")
        yield Shot(source=source, camera=camera, exrs=exrs, png=png, keep=output.is_sequence)


def _network_and_width(options: RenderOptions) -> tuple[str | None, int]:
    """Return the checkpoint (None without a network) and the width of pictures in pixels."""
    if options.engine == "mitsuba":
        return None, options.resolution or _RESOLUTION
    require_torch("--engine neural")
    from model.open import BUILTIN, find_network

    checkpoint = options.checkpoint or BUILTIN
    if options.resolution is not None:
        return checkpoint, options.resolution
    network = find_network(checkpoint)
    return (
        checkpoint,
        _RESOLUTION if network.any_width else network.trained.resolution or _RESOLUTION,
    )


def _renderers(
    options: RenderOptions, quality: Traced | None, checkpoint: str | None, resolution: int
) -> list[Renderer]:
    """Return the renderers of `--engine`; without a quality, the network of budgets alone."""
    if quality is None:
        from model.open import BUILTIN_TOKENS

        checkpoint = BUILTIN_TOKENS
    renderers = list[Renderer]()
    if quality is not None and options.engine != "neural":
        child = RenderChild(choose_variant("auto"), options.threads)
        renderers.append(PathTracer(child, quality, resolution, seed=options.seed))
    if checkpoint is not None:
        network = NetworkRenderer(
            checkpoint=checkpoint,
            resolution=resolution,
            lights_per_pass=options.lights_per_pass,
            precision=options.precision,
            threads=options.threads,
        )
        renderers.append(network)
    return renderers


def _choose(budget: Budget, pairs: Pairs, resolution: int, threads: int | None) -> Choice:
    table = shipped_table()
    costs, source = known_costs(choose_variant("auto"))
    cores = available_cores()
    candidates = price_all(
        table,
        costs,
        width=resolution,
        threads=min(threads or cores, cores),
        per_scene=len(pairs) / len({source for source, _ in pairs}),
        network=importlib.util.find_spec("torch") is not None,
    )
    return choose(budget, candidates, scenes=table.scenes, costs=source, width=resolution)


def _pairs(options: RenderOptions, reader: SceneReader, output: OutputPaths) -> Pairs:
    if not output.is_sequence:
        if options.orbit is None and options.cameras is None:
            return [(scene_source(options.source), options.view)]
        raise TrilightError(f"--out is {options.out}; expected a folder, X.mp4 or X.webp for many.")
    sources = scene_sources(options.source, reader)
    cameras: Sequence[Camera | int] = [options.view]
    if options.cameras is not None:
        cameras = camera_path(options.cameras, reader, options.view)
    elif options.orbit is not None:
        scene = reader.load(sources[0]).scene
        cameras = orbit(scene, own_camera(scene, options.view), options.orbit, options.arc_deg)
    return pair_cameras(sources, cameras)
