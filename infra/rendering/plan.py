"""All that one call of `trilight render` will do: decided once, before any picture is made."""

import importlib.util
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from infra.rendering.cameras import ShotCamera, camera_path, orbit, own_camera, paired
from infra.rendering.engines import EnginePlan, MitsubaPlan, NeuralPlan
from infra.rendering.look import Look
from infra.rendering.places import PicturePlaces, place
from infra.rendering.request import Asked, EngineChoice
from infra.rendering.sources import scene_sources
from infra.rendering.way_table import known_costs, shipped_table
from infra.rendering.ways import Choice, Way, chosen_way, priced_ways
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
    """One picture to make."""

    source: SceneSource
    """The scene."""
    camera: ShotCamera | int
    """From where; a number is the row of the scene's own camera."""
    exrs: Mapping[str, Path]
    """What is measured: a file for each engine, by its name."""
    png: Path
    """What people look at."""
    keep: bool
    """Whether files of this very picture that are there already are kept."""

    @property
    def name(self) -> str:
        """The picture in messages."""
        if isinstance(self.camera, int):
            return f"{self.source.name}, view {self.camera}"
        return f"{self.source.name}, picture {self.png.stem}"


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderPlan:
    """What is rendered, by what, and to which files. Nothing in it is open or left to a default."""

    source: str
    """Scene or scenes as the user named them."""
    view: int
    """Row of the camera of a scene that the user named."""
    engine: EngineChoice
    """As the user named it."""
    engines: Sequence[EnginePlan]
    """One, or Mitsuba and the network."""
    resolution: int
    """Width of every picture in pixels."""
    look: Look
    """Of the PNG files."""
    place: PicturePlaces
    """Where the pictures are."""
    shots: Sequence[Shot]
    """Picture by picture; shots of one scene follow each other."""
    fps: int
    """Pictures a second of the video, if there is one."""
    choice: Choice | None = None
    """How the way to the pictures was chosen, where seconds or an error were asked for."""


def plan_render(asked: Asked, reader: SceneReader) -> RenderPlan:
    """Return the plan of what a user asked for; makes the folder of the files.

    Raises:
        TrilightError: an option that means nothing, a source, camera or checkpoint that is
            unusable, or a place that cannot be written.
    """
    checkpoint, resolution = _network_and_width(asked)
    settings = _settings(asked, resolution)
    look = Look(tone_map=asked.tone_map, exposure_ev=asked.exposure_ev)
    if asked.out.suffix.lower() == ".exr":
        scene_source(asked.source)  # a wrong name is said before any library is loaded
    where = place(asked.out)
    pairs = _pairs(asked, reader) if where.is_sequence else _one_pair(asked)
    choice = _choice(asked, pairs, resolution)
    if choice is None:
        engines = _engines(asked, settings, checkpoint)
    else:
        engines = [_engine_of(choice.priced.way, asked, resolution)]
    return RenderPlan(
        source=asked.source,
        view=asked.view,
        engine=asked.engine if choice is None else choice.engine,
        engines=engines,
        resolution=settings.resolution,
        look=look,
        place=where,
        shots=list(shots(pairs, where, [engine.name for engine in engines])),
        fps=asked.fps,
        choice=choice,
    )


def shots(
    pairs: Sequence[tuple[SceneSource, ShotCamera | int]], where: PicturePlaces, names: list[str]
) -> Iterator[Shot]:
    """Yield the pictures of scenes by cameras with their files.

    Args:
        pairs: scene and camera of each picture.
        where: the files go.
        names: of the engines.
    """
    for index, (source, camera) in enumerate(pairs):
        stem = where.stem_of(index)
        suffixes = {name: f".{name}.exr" if len(names) > 1 else ".exr" for name in names}
        exrs = {name: Path(f"{stem}{suffix}") for name, suffix in suffixes.items()}
        png = Path(f"{stem}.png")
        yield Shot(source=source, camera=camera, exrs=exrs, png=png, keep=where.is_sequence)


def _network_and_width(asked: Asked) -> tuple[str | None, int]:
    """Return the checkpoint, if a network renders, and the width of pictures in pixels."""
    if asked.engine == "mitsuba":
        return None, asked.resolution or _RESOLUTION
    require_torch("--engine neural")
    from model.open import BUILTIN, find_network
    from train.loop.checkpoints import network_of_run

    checkpoint = asked.checkpoint or BUILTIN
    if asked.resolution is not None:
        return checkpoint, asked.resolution
    found = find_network(checkpoint, network_of_run)
    return checkpoint, _RESOLUTION if found.any_width else found.trained.resolution or _RESOLUTION


def _settings(asked: Asked, resolution: int) -> RenderSettings | PreviewSettings:
    """Return how pictures are made; for a choice the least preview, until pictures are counted."""
    if asked.seconds is not None or asked.error_db is not None:
        return PreviewSettings(resolution=resolution, spp=1)
    if asked.spp is not None:
        return PreviewSettings(
            resolution=resolution,
            spp=asked.spp,
            denoiser=asked.denoiser or usual_filter(asked.spp),
        )
    return one_picture(
        resolution=resolution,
        max_spp=asked.max_spp,
        noise_floor_db=asked.noise_floor_db,
        noise_floor_linear_db=asked.noise_floor_linear_db,
        noise_floor_objects_db=asked.noise_floor_objects_db,
        split=asked.split,
        split_lobes=asked.split_lobes,
    )


def _engines(
    asked: Asked, settings: RenderSettings | PreviewSettings, checkpoint: str | None
) -> list[EnginePlan]:
    engines = list[EnginePlan]()
    if asked.engine != "neural":
        engines.append(_mitsuba(asked, settings))
    if checkpoint is not None:
        engines.append(_neural(asked, checkpoint, settings.resolution))
    return engines


def _engine_of(way: Way, asked: Asked, resolution: int) -> EnginePlan:
    """Return the engine of a way that was chosen."""
    if way.rung == "network":
        from model.open import BUILTIN_TOKENS

        return _neural(asked, BUILTIN_TOKENS, resolution)
    settings = PreviewSettings(resolution=resolution, spp=way.spp, denoiser=way.denoiser)
    return _mitsuba(asked, settings)


def _mitsuba(asked: Asked, settings: RenderSettings | PreviewSettings) -> MitsubaPlan:
    return MitsubaPlan(
        settings=settings,
        seed=asked.seed,
        threads=asked.threads or os.cpu_count() or 1,
        variant=choose_variant(),
    )


def _neural(asked: Asked, checkpoint: str, resolution: int) -> NeuralPlan:
    return NeuralPlan(
        checkpoint=checkpoint,
        precision=asked.precision,
        resolution=resolution,
        lights_per_pass=asked.lights_per_pass,
        threads=asked.threads,
    )


def _choice(
    asked: Asked, pairs: Sequence[tuple[SceneSource, ShotCamera | int]], resolution: int
) -> Choice | None:
    """Return the way that seconds or an error choose, where one of them was asked for."""
    if asked.seconds is None and asked.error_db is None:
        return None
    table = shipped_table()
    known = known_costs(choose_variant())
    cores = os.cpu_count() or 1
    ways = priced_ways(
        table,
        known.costs,
        width=resolution,
        threads=min(asked.threads or cores, cores),
        per_scene=len(pairs) / len({source for source, _ in pairs}),
        network=importlib.util.find_spec("torch") is not None,
    )
    return chosen_way(
        ways, table, known, seconds=asked.seconds, error_db=asked.error_db, width=resolution
    )


def _one_pair(asked: Asked) -> list[tuple[SceneSource, ShotCamera | int]]:
    if asked.orbit is not None or asked.cameras is not None:
        raise TrilightError(f"--out is {asked.out}; expected a folder, X.mp4 or X.webp for many.")
    return [(scene_source(asked.source), asked.view)]


def _pairs(asked: Asked, reader: SceneReader) -> list[tuple[SceneSource, ShotCamera | int]]:
    sources = scene_sources(asked.source, reader)
    cameras: Sequence[ShotCamera | int] = [asked.view]
    if asked.cameras is not None:
        cameras = camera_path(asked.cameras, reader, asked.view)
    elif asked.orbit is not None:
        scene = reader.load(sources[0]).scene
        cameras = orbit(scene, own_camera(scene, asked.view), asked.orbit, asked.arc_deg)
    return paired(sources, cameras)
