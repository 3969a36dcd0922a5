"""One call of `trilight render`: renders every picture of a plan, or keeps an equal one."""

import itertools
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Protocol

from infra.render.budget import Choice
from infra.render.comparison import Flicker, Frame, comparison_sheet, flicker, log_error
from infra.render.output_paths import write_video
from infra.render.picture_file import (
    PictureFile,
    Radiance,
    header_of,
    load_matching_picture,
    write_picture,
)
from infra.render.plan import RenderPlan, Shot
from infra.render.sources import own_camera
from infra.render.tone_mapping import Look, display_pixels
from pipeline.documents.png import encode_png
from pipeline.exchange.formats import SceneSource
from pipeline.exchange.reader import SceneReader
from pipeline.renders.settings import FIRST_SPP
from storage.atomic import write_atomically
from storage.metrics import psnr_log_db
from storage.records.lights import num_lights
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from storage.renderer import Facts, Image, OnProgress, ReadyScene, Renderer, Sampling


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedShot:
    """Result of one shot."""

    shot: Shot
    scene_sha256: str
    """SHA-256 of the scene by storage.records.scene_file.scene_digest."""
    num_triangles: int
    num_lights: int
    """Number of emitter objects of the scene, not of their triangles."""
    pictures: Mapping[str, PictureFile]
    """Files by the name of their renderer."""
    psnr_log_db: float | None
    """PSNR of the network's picture against the traced one; None without both."""
    flicker: Flicker | None
    """Flicker since the preceding picture of the scene or stage; None without both renderers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderResult:
    """Result of a plan."""

    plan: RenderPlan
    shots: Sequence[FinishedShot]
    notes: Sequence[str]
    """Warnings about scenes and pictures, each once."""


class RenderProgress(Protocol):
    """Callbacks on the progress of a render."""

    def on_picture(self, done: int, total: int) -> None:
        """Report the number of finished pictures and of all."""

    def on_samples(self, now: Sampling | Image) -> None:
        """Report a finished pass of the path tracer."""


def run_plan(plan: RenderPlan, reader: SceneReader, watcher: RenderProgress) -> RenderResult:
    """Render every picture of a plan, and write the video.

    Raises:
        TrilightError: a network or a scene cannot be loaded or rendered, or a file cannot be
            written.
    """
    finished = list[FinishedShot]()
    notes = dict[str, None]()
    before: Frame | None = None
    with ExitStack() as stack:
        for renderer in plan.renderers:
            stack.enter_context(closing(renderer))
        watcher.on_picture(0, len(plan.shots))
        for source, shots in itertools.groupby(plan.shots, key=lambda shot: shot.source):
            source_scene = reader.load(source)
            scene = _SceneAtHand(source, source_scene.scene, plan.choice, watcher.on_samples)
            for shot in shots:
                made = {each.name: scene.picture(shot, each) for each in plan.renderers}
                done, before = _finish(shot, scene, made, plan.look, before)
                finished.append(done)
                watcher.on_picture(len(finished), len(plan.shots))
            notes |= dict.fromkeys([*source_scene.notes, *scene.notes])
    if plan.output.video is not None:
        write_video(plan.output.video, [done.shot.png for done in finished], plan.fps)
    for renderer in plan.renderers:
        notes |= dict.fromkeys(_caveats(renderer, finished))
    return RenderResult(plan=plan, shots=finished, notes=list(notes))


class _SceneAtHand:
    """Scene of consecutive shots; a renderer loads it for the first picture that is not kept."""

    def __init__(
        self, source: SceneSource, scene: Scene, choice: Choice | None, on_progress: OnProgress
    ) -> None:
        self.scene = scene
        self.sha256 = scene_digest(scene)
        self.notes: list[str] = []
        self._source = source
        self._facts: Facts = {} if choice is None else choice.facts
        self._on_progress = on_progress
        self._loaded: dict[str, ReadyScene] = {}

    def picture(self, shot: Shot, renderer: Renderer) -> tuple[PictureFile, Radiance]:
        """Return the picture of one renderer, from an equal file or rendered."""
        camera = shot.camera
        if isinstance(camera, int):
            camera = own_camera(self.scene, camera)
        path = shot.exrs[renderer.name]
        header = header_of(renderer, self._source.name, self.sha256, camera)
        existing = load_matching_picture(path, header) if shot.keep else None
        if existing is not None:
            return existing
        seconds = 0.0
        loaded = self._loaded.get(renderer.name)
        if loaded is None:
            loaded = self._loaded[renderer.name] = renderer.load(self.scene, self._source.name)
            self.notes += [f"{self._source.name}: {note}" for note in loaded.notes]
            seconds = loaded.seconds
        began = time.perf_counter()
        image = loaded.render(camera, self._on_progress)
        seconds += time.perf_counter() - began
        return write_picture(path, header, image, {**image.facts, **self._facts}, seconds)


def _finish(
    shot: Shot,
    scene: _SceneAtHand,
    made: Mapping[str, tuple[PictureFile, Radiance]],
    look: Look,
    before: Frame | None,
) -> tuple[FinishedShot, Frame | None]:
    """Write the PNG; return the finished shot, and the frame if there are both renderers."""
    files = {name: file for name, (file, _) in made.items()}
    radiances = {name: radiance_rgb for name, (_, radiance_rgb) in made.items()}
    now = None
    agreement = None
    if len(made) == 1:
        (radiance_rgb,) = radiances.values()
        pixels = display_pixels(radiance_rgb, look)
    else:
        traced = radiances["mitsuba"]
        neural = radiances["neural"]
        pixels = comparison_sheet(traced, neural, look)
        agreement = psnr_log_db(neural, traced)
        now = Frame(
            source=shot.source,
            error_RR3=log_error(neural, traced),
            noise_floor_db=float(files["mitsuba"].facts["noise_floor_db"]),
        )
    write_atomically(shot.png, encode_png(pixels))
    finished = FinishedShot(
        shot=shot,
        scene_sha256=scene.sha256,
        num_triangles=scene.scene.num_triangles,
        num_lights=num_lights(scene.scene),
        pictures=files,
        psnr_log_db=agreement,
        flicker=flicker(before, now) if now else None,
    )
    return finished, now


def _caveats(renderer: Renderer, finished: Sequence[FinishedShot]) -> list[str]:
    """Return warnings about all pictures of a renderer together."""
    pictures = [shot.pictures[renderer.name] for shot in finished]
    every = [picture.facts for picture in pictures]
    notes = []
    black = sum(picture.is_black for picture in pictures)
    if black:
        which = "the picture is" if len(pictures) == 1 else f"{black} pictures are"
        notes.append(f"{renderer.name}: {which} black: the camera sees nothing that is lit")
    if any(int(facts.get("clipped_pixels", 0)) for facts in every):
        notes.append(f"{renderer.name}: pixels beyond what half floats hold were clipped")
    sampled = [facts for facts in every if "spp" in facts]
    if any("noise_floor_db" not in facts for facts in sampled):
        notes.append(
            "the error of a preview is not measured, so that its stated error is unknown: "
            "--noise-floor 40 measures it and samples on to it"
        )
    elif any(
        int(facts["spp"]) < FIRST_SPP and "expected_error_db" not in facts for facts in sampled
    ):
        notes.append(f"below {FIRST_SPP} samples the stated error may flatter")
    return [*notes, *renderer.notes]
