"""One call of `trilight render`: from what the user asked for to files."""

import dataclasses
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from infra.rendering.asked import Asked
from infra.rendering.cameras import Shot, ShotCamera, camera_path, orbit, own_camera, shots
from infra.rendering.engines import Engine, MitsubaEngine, NeuralEngine
from infra.rendering.look import Look
from infra.rendering.places import PicturePlaces, place
from infra.rendering.run import FinishedShot, ShotRun
from infra.rendering.sources import scene_sources
from infra.rendering.tone_maps import require_tone_map
from infra.rendering.video import write_video
from infra.torch_library import require_torch
from pipeline.exchange.open_scene import SceneSource, scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.renders.settings import FIRST_SPP, RenderSettings, one_picture
from pipeline.renders.variant import choose_variant
from storage.errors import TrilightError

if TYPE_CHECKING:
    from pipeline.renders.renderer import Sampling

ENGINES = {"mitsuba": ("mitsuba",), "neural": ("neural",), "both": ("mitsuba", "neural")}
"""Who renders, by what `--engine` may be."""

_RESOLUTION = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderOutcome:
    """What came of it."""

    asked: Asked
    """With network and width, where none was named."""
    place: PicturePlaces
    """Where the files are."""
    shots: tuple[FinishedShot, ...]
    """Picture by picture."""
    settings: RenderSettings
    """Of the path tracer."""
    notes: tuple[str, ...]
    """What a person should know."""


class RenderWatcher(Protocol):
    """Is told how far a render is."""

    def pictures(self, done: int, total: int) -> None:
        """So many pictures are finished."""

    def sampled(self, now: "Sampling") -> None:
        """The path tracer has finished a pass."""


def render_asked(asked: Asked, watcher: RenderWatcher) -> RenderOutcome:
    """Render what was asked for and write its files.

    Raises:
        TrilightError: an option that means nothing, a source, camera or checkpoint that is
            unusable, a scene that cannot be rendered, or files that cannot be written.
    """
    asked = _completed(asked)
    settings = _settings(asked)
    look = Look(tone_map=require_tone_map(asked.tone_map), exposure_ev=asked.exposure_ev)
    if asked.out.suffix.lower() == ".exr":
        scene_source(asked.source)  # a wrong name is said before any library is loaded
    where = place(asked.out)
    with ExitStack() as stack:
        reader = stack.enter_context(SceneReader(asked.albedo_over_one))
        wanted = _shots(asked, where, reader)
        engines = [_engine(name, asked, settings, watcher, stack) for name in ENGINES[asked.engine]]
        run = ShotRun(engines, where, view=asked.view, look=look)
        watcher.pictures(0, len(wanted))
        finished = run.run(wanted, reader, lambda now: watcher.pictures(now, len(wanted)))
    if where.video is not None:
        write_video(where.video, [shot.png for shot in finished], asked.fps)
    return RenderOutcome(
        asked=asked,
        place=where,
        shots=tuple(finished),
        settings=settings,
        notes=(*run.notes, *_notes(asked, finished)),
    )


def _completed(asked: Asked) -> Asked:
    """Return it with the network and the width that are taken where none is named."""
    checkpoint, resolution = asked.checkpoint, asked.resolution
    if asked.engine != "mitsuba":
        require_torch("--engine neural")
        from model.open import BUILTIN, find_network
        from train.loop.checkpoints import network_of_run

        checkpoint = checkpoint or BUILTIN
        if resolution is None:
            resolution = find_network(checkpoint, network_of_run).trained.resolution
    if resolution is None:
        resolution = _RESOLUTION
    return dataclasses.replace(asked, checkpoint=checkpoint, resolution=resolution)


def _settings(asked: Asked) -> RenderSettings:
    assert asked.resolution is not None
    return one_picture(
        resolution=asked.resolution,
        noise_floor_db=asked.noise_floor_db,
        max_spp=asked.max_spp,
    )


def _shots(asked: Asked, where: PicturePlaces, reader: SceneReader) -> list[Shot]:
    if where.is_sequence:
        sources = scene_sources(asked.source, reader)
        return shots(sources, _cameras(asked, sources[0], reader))
    if asked.orbit is not None or asked.cameras is not None:
        raise TrilightError(f"--out is {asked.out}; expected a folder, X.mp4 or X.webp for many.")
    return shots([scene_source(asked.source)], None)


def _cameras(asked: Asked, first: SceneSource, reader: SceneReader) -> list[ShotCamera] | None:
    if asked.cameras is not None:
        return camera_path(asked.cameras, reader, asked.view)
    if asked.orbit is None:
        return None
    scene = reader.load(first).scene
    return orbit(scene, own_camera(scene, asked.view), asked.orbit, asked.arc_deg)


def _engine(
    name: str, asked: Asked, settings: RenderSettings, watcher: RenderWatcher, stack: ExitStack
) -> Engine:
    make: Callable[..., Engine] = _mitsuba if name == "mitsuba" else _neural
    engine = make(asked, settings, watcher)
    stack.callback(engine.close)
    return engine


def _mitsuba(asked: Asked, settings: RenderSettings, watcher: RenderWatcher) -> Engine:
    from pipeline.making.render_scene import PathTracer

    tracer = PathTracer(
        settings,
        seed=asked.seed,
        variant=choose_variant(),
        threads=asked.threads or os.cpu_count() or 1,
        sampled=watcher.sampled,
    )
    return MitsubaEngine(tracer)


def _neural(asked: Asked, settings: RenderSettings, watcher: RenderWatcher) -> Engine:
    import torch

    from model.neural_renderer import NeuralRenderer
    from train.loop.checkpoints import network_of_run

    if asked.threads is not None:
        torch.set_num_threads(asked.threads)
    assert asked.checkpoint is not None
    return NeuralEngine(
        NeuralRenderer.load(asked.checkpoint, precision=asked.precision, finders=[network_of_run]),
        checkpoint=asked.checkpoint,
        precision=asked.precision,
        resolution=settings.resolution,
        lights_per_pass=asked.lights_per_pass,
        skip_empty_bundles=asked.skip_empty_bundles,
    )


def _notes(asked: Asked, finished: list[FinishedShot]) -> list[str]:
    notes = []
    for name in ENGINES[asked.engine]:
        pictures = [shot.pictures[name] for shot in finished]
        black = sum(picture.is_black for picture in pictures)
        if black:
            which = "the picture is" if len(pictures) == 1 else f"{black} pictures are"
            notes.append(f"{name}: {which} black: the camera sees nothing that is lit")
        if any(int(picture.facts.get("clipped_pixels", 0)) for picture in pictures):
            notes.append(f"{name}: pixels beyond what half floats hold were clipped")
    if "mitsuba" in ENGINES[asked.engine]:
        if any(int(shot.pictures["mitsuba"].facts["spp"]) < FIRST_SPP for shot in finished):
            notes.append(f"below {FIRST_SPP} samples the measured noise floor may flatter")
        variant = choose_variant()
        if variant.note:
            notes.append(f"{variant.note}; see trilight doctor")
    return notes
