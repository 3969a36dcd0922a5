"""One call of `trilight render`: renders every picture of a plan, or keeps an equal one."""

import dataclasses
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from infra.render.cameras import own_camera
from infra.render.comparison import Flicker, Frame, comparison_sheet, flicker, log_error
from infra.render.engines import Engine, OpenedScene
from infra.render.look import Look, display_pixels
from infra.render.options import RenderOptions
from infra.render.picture_file import (
    PictureFile,
    PictureKey,
    Radiance,
    load_matching_picture,
    write_picture,
)
from infra.render.plan import RenderPlan, Shot, plan_render
from infra.render.video import write_video
from infra.render.ways import Choice
from pipeline.documents.png import encode_png
from pipeline.exchange.reader import SceneReader
from storage.atomic import write_atomically
from storage.metrics import psnr_log_db
from storage.records.lights import num_lights
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest

if TYPE_CHECKING:
    from storage.renderer import Sampling


@dataclass(frozen=True, kw_only=True)
class SceneIdentity:
    """Digest and size of a scene."""

    digest: str
    """SHA-256 of the scene by storage.records.scene_file.scene_digest."""
    num_triangles: int
    """Number of triangles, emitting ones included."""
    num_lights: int
    """Number of emitter objects, not of their triangles."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedShot:
    """Result of one shot."""

    shot: Shot
    scene: SceneIdentity
    pictures: Mapping[str, PictureFile]
    """Files by the name of their engine."""
    psnr_log_db: float | None
    """PSNR of the network's picture against the traced one; None without both."""
    flicker: Flicker | None
    """Flicker since the preceding picture of the scene or stage; None without both engines."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderResult:
    """Result of a plan."""

    plan: RenderPlan
    shots: Sequence[FinishedShot]
    """Results in the order of the plan's shots."""
    notes: Sequence[str]
    """Warnings about scenes and pictures, each once."""


class RenderProgress(Protocol):
    """Callbacks on the progress of a render."""

    def on_choice(self, choice: Choice) -> None:
        """Report the quality preset that --seconds or --error chose."""

    def on_picture(self, done: int, total: int) -> None:
        """Report the number of finished pictures and of all."""

    def on_samples(self, now: "Sampling") -> None:
        """Report a finished pass of the path tracer."""


def render_from_options(options: RenderOptions, watcher: RenderProgress) -> RenderResult:
    """Plan a render and run the plan; raises TrilightError as these two do."""
    with SceneReader(options.albedo_over_one) as reader:
        return run_plan(plan_render(options, reader), reader, watcher)


def run_plan(plan: RenderPlan, reader: SceneReader, watcher: RenderProgress) -> RenderResult:
    """Render every picture of a plan, and write the video.

    Raises:
        TrilightError: a network or a scene cannot be loaded or rendered, or a file cannot be
            written.
    """
    finished = list[FinishedShot]()
    notes = dict[str, None]()
    choice = plan.choice
    if choice is not None:
        watcher.on_choice(choice)
    before: Frame | None = None
    with ExitStack() as stack:
        engines = {
            each.name: stack.enter_context(closing(each.start(watcher.on_samples)))
            for each in plan.engines
        }
        watcher.on_picture(0, len(plan.shots))
        for scene, shot in _with_scenes(plan.shots, reader):
            made = {
                name: _picture(shot, name, engine, scene, choice)
                for name, engine in engines.items()
            }
            done, before = _finish(shot, scene.identity, made, plan.look, before)
            finished.append(done)
            notes |= dict.fromkeys(scene.notes)
            watcher.on_picture(len(finished), len(plan.shots))
    if plan.output.video is not None:
        write_video(plan.output.video, [done.shot.png for done in finished], plan.fps)
    return RenderResult(plan=plan, shots=finished, notes=[*notes, *_caveats(plan, finished)])


@dataclass(frozen=True, kw_only=True, eq=False)
class _SceneAtHand:
    """Scene of the current shots."""

    scene: Scene
    identity: SceneIdentity
    notes: list[str]
    """Warnings about its file, and then those of each engine that opened it."""
    opened: dict[str, OpenedScene]
    """Opened scene by the name of its engine, from the first picture on that is not kept."""


def _with_scenes(shots: Sequence[Shot], reader: SceneReader) -> Iterator[tuple[_SceneAtHand, Shot]]:
    """Yield shots with their scenes; a scene is read once for consecutive shots."""
    for source, same_scene in itertools.groupby(shots, key=lambda shot: shot.source):
        loaded = reader.load(source)
        identity = SceneIdentity(
            digest=scene_digest(loaded.scene),
            num_triangles=loaded.scene.num_triangles,
            num_lights=num_lights(loaded.scene),
        )
        at_hand = _SceneAtHand(
            scene=loaded.scene, identity=identity, notes=list(loaded.notes), opened={}
        )
        for shot in same_scene:
            yield at_hand, shot


def _picture(
    shot: Shot, name: str, engine: Engine, at_hand: _SceneAtHand, choice: Choice | None
) -> tuple[PictureFile, Radiance]:
    """Return the picture of one engine, from an equal file or rendered."""
    view = shot.camera if isinstance(shot.camera, int) else None
    camera = own_camera(at_hand.scene, shot.camera) if isinstance(shot.camera, int) else shot.camera
    key = PictureKey(
        engine=name,
        identity=engine.identity,
        source=shot.source.name,
        scene_sha256=at_hand.identity.digest,
        camera=camera,
        view=view,
    )
    existing = load_matching_picture(shot.exrs[name], key) if shot.keep else None
    if existing is not None:
        return existing
    seconds = 0.0
    if name not in at_hand.opened:
        at_hand.opened[name] = engine.open(at_hand.scene, shot.source.name)
        at_hand.notes.extend(at_hand.opened[name].notes)
        seconds = at_hand.opened[name].seconds
    began = time.perf_counter()
    rendered = at_hand.opened[name].render(camera, shot.name)
    seconds += time.perf_counter() - began
    if choice is not None:
        rendered = dataclasses.replace(rendered, facts={**rendered.facts, **choice.facts})
    written, radiance_rgb = write_picture(shot.exrs[name], key, rendered)
    return dataclasses.replace(written, seconds=seconds), radiance_rgb


def _finish(
    shot: Shot,
    scene: SceneIdentity,
    made: Mapping[str, tuple[PictureFile, Radiance]],
    look: Look,
    before: Frame | None,
) -> tuple[FinishedShot, Frame | None]:
    """Write the PNG; return the finished shot, and the frame if there are both engines."""
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
        scene=scene,
        pictures=files,
        psnr_log_db=agreement,
        flicker=flicker(before, now) if now else None,
    )
    return finished, now


def _caveats(plan: RenderPlan, finished: Sequence[FinishedShot]) -> list[str]:
    """Return warnings about all pictures together."""
    notes = []
    for engine in plan.engines:
        pictures = [shot.pictures[engine.name] for shot in finished]
        black = sum(picture.is_black for picture in pictures)
        if black:
            which = "the picture is" if len(pictures) == 1 else f"{black} pictures are"
            notes.append(f"{engine.name}: {which} black: the camera sees nothing that is lit")
        if any(int(picture.facts.get("clipped_pixels", 0)) for picture in pictures):
            notes.append(f"{engine.name}: pixels beyond what half floats hold were clipped")
    for engine in plan.engines:
        notes += engine.caveats([shot.pictures[engine.name].facts for shot in finished])
    return notes
