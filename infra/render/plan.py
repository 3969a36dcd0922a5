"""Plan of one call of `trilight render`: all decisions, before any picture is rendered."""

import importlib.util
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from infra.render.cameras import ShotCamera, camera_path, orbit, own_camera, pair_cameras
from infra.render.engines import EnginePlan, MitsubaPlan, NeuralPlan
from infra.render.look import Look
from infra.render.options import EngineChoice, RenderOptions
from infra.render.output_paths import OutputPaths, output_paths
from infra.render.sources import scene_sources
from infra.render.way_table import known_costs, shipped_table
from infra.render.ways import Choice, Way, chosen_way, priced_ways
from infra.torch_library import require_torch
from pipeline.exchange.open_scene import SceneSource, scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.renders.preview import PreviewSettings, usual_filter
from pipeline.renders.settings import RenderSettings, one_picture
from pipeline.renders.variant import choose_variant
from storage.errors import TrilightError

_RESOLUTION = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One picture to render."""

    source: SceneSource
    camera: ShotCamera | int
    """Camera, or the row of a camera of the scene."""
    exrs: Mapping[str, Path]
    """Paths of the EXR files by the name of their engine."""
    png: Path
    """Path of the PNG file for people."""
    keep: bool
    """True to keep existing files of an equal picture."""

    @property
    def name(self) -> str:
        """Name of the picture in messages."""
        if isinstance(self.camera, int):
            return f"{self.source.name}, view {self.camera}"
        return f"{self.source.name}, picture {self.png.stem}"


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderPlan:
    """Pictures, engines and files of a render, with all defaults resolved."""

    source: str
    """Scene or scenes as the user named them."""
    view: int
    """Row of the scene's camera that the user named."""
    engine: EngineChoice
    """Value of `--engine`, or the engine that --seconds or --error chose."""
    engines: Sequence[EnginePlan]
    """One engine, or Mitsuba and the network."""
    resolution: int
    """Width of every picture in pixels."""
    look: Look
    """Display options of the PNG files."""
    output: OutputPaths
    """Paths of pictures and video."""
    shots: Sequence[Shot]
    """Pictures in order; those of one scene are consecutive."""
    fps: int
    """Frames per second of the video."""
    choice: Choice | None = None
    """Quality preset that --seconds or --error chose; None without these."""


def plan_render(options: RenderOptions, reader: SceneReader) -> RenderPlan:
    """Return the plan of a render, and make the folder of its files.

    Raises:
        TrilightError: an option without effect, an unusable source, camera or checkpoint, or a
            folder that cannot be written.
    """
    checkpoint, resolution = _network_and_width(options)
    settings = _settings(options, resolution)
    look = Look(tone_map=options.tone_map, exposure_ev=options.exposure_ev)
    if options.out.suffix.lower() == ".exr":
        scene_source(options.source)  # reports a wrong name before any library is loaded
    output = output_paths(options.out)
    pairs = _pairs(options, reader) if output.is_sequence else _one_pair(options)
    choice = _choice(options, pairs, resolution)
    if choice is None:
        engines = _engines(options, settings, checkpoint)
    else:
        engines = [_engine_of(choice.priced.way, options, resolution)]
    return RenderPlan(
        source=options.source,
        view=options.view,
        engine=options.engine if choice is None else choice.engine,
        engines=engines,
        resolution=settings.resolution,
        look=look,
        output=output,
        shots=list(shots(pairs, output, [engine.name for engine in engines])),
        fps=options.fps,
        choice=choice,
    )


def shots(
    pairs: Sequence[tuple[SceneSource, ShotCamera | int]], output: OutputPaths, names: list[str]
) -> Iterator[Shot]:
    """Yield a shot for each pair of scene and camera, with its files.

    Args:
        pairs: scene and camera of each picture.
        output: paths of the pictures.
        names: names of the engines.
    """
    for index, (source, camera) in enumerate(pairs):
        stem = output.stem_of(index)
        suffixes = {name: f".{name}.exr" if len(names) > 1 else ".exr" for name in names}
        exrs = {name: Path(f"{stem}{suffix}") for name, suffix in suffixes.items()}
        png = Path(f"{stem}.png")
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


def _settings(options: RenderOptions, resolution: int) -> RenderSettings | PreviewSettings:
    """Return the render settings; with --seconds or --error a placeholder until `_choice`."""
    if options.seconds is not None or options.error_db is not None:
        return PreviewSettings(resolution=resolution, spp=1)
    if options.spp is not None:
        return PreviewSettings(
            resolution=resolution,
            spp=options.spp,
            denoiser=options.denoiser or usual_filter(options.spp),
        )
    return one_picture(
        resolution=resolution,
        max_spp=options.max_spp,
        noise_targets=options.noise_targets,
        split=options.split,
        split_lobes=options.split_lobes,
    )


def _engines(
    options: RenderOptions, settings: RenderSettings | PreviewSettings, checkpoint: str | None
) -> list[EnginePlan]:
    engines = list[EnginePlan]()
    if options.engine != "neural":
        engines.append(_mitsuba(options, settings))
    if checkpoint is not None:
        engines.append(_neural(options, checkpoint, settings.resolution))
    return engines


def _engine_of(preset: Way, options: RenderOptions, resolution: int) -> EnginePlan:
    """Return the engine of the chosen quality preset."""
    if preset.rung == "network":
        from model.open import BUILTIN_TOKENS

        return _neural(options, BUILTIN_TOKENS, resolution)
    settings = PreviewSettings(resolution=resolution, spp=preset.spp, denoiser=preset.denoiser)
    return _mitsuba(options, settings)


def _mitsuba(options: RenderOptions, settings: RenderSettings | PreviewSettings) -> MitsubaPlan:
    return MitsubaPlan(
        settings=settings,
        seed=options.seed,
        threads=options.threads or os.cpu_count() or 1,
        variant=choose_variant("auto"),
    )


def _neural(options: RenderOptions, checkpoint: str, resolution: int) -> NeuralPlan:
    return NeuralPlan(
        checkpoint=checkpoint,
        precision=options.precision,
        resolution=resolution,
        lights_per_pass=options.lights_per_pass,
        threads=options.threads,
    )


def _choice(
    options: RenderOptions, pairs: Sequence[tuple[SceneSource, ShotCamera | int]], resolution: int
) -> Choice | None:
    """Return the quality preset for --seconds or --error; None without these."""
    if options.seconds is None and options.error_db is None:
        return None
    table = shipped_table()
    known = known_costs(choose_variant("auto"))
    cores = os.cpu_count() or 1
    candidates = priced_ways(
        table,
        known.costs,
        width=resolution,
        threads=min(options.threads or cores, cores),
        per_scene=len(pairs) / len({source for source, _ in pairs}),
        network=importlib.util.find_spec("torch") is not None,
    )
    return chosen_way(
        candidates,
        table,
        known,
        seconds=options.seconds,
        error_db=options.error_db,
        width=resolution,
    )


def _one_pair(options: RenderOptions) -> list[tuple[SceneSource, ShotCamera | int]]:
    if options.orbit is not None or options.cameras is not None:
        raise TrilightError(f"--out is {options.out}; expected a folder, X.mp4 or X.webp for many.")
    return [(scene_source(options.source), options.view)]


def _pairs(
    options: RenderOptions, reader: SceneReader
) -> list[tuple[SceneSource, ShotCamera | int]]:
    sources = scene_sources(options.source, reader)
    cameras: Sequence[ShotCamera | int] = [options.view]
    if options.cameras is not None:
        cameras = camera_path(options.cameras, reader, options.view)
    elif options.orbit is not None:
        scene = reader.load(sources[0]).scene
        cameras = orbit(scene, own_camera(scene, options.view), options.orbit, options.arc_deg)
    return pair_cameras(sources, cameras)
