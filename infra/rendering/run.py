"""Shots to files: every picture by every engine, those that are there already kept."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray

from infra.rendering.cameras import Shot, own_camera
from infra.rendering.comparison import comparison_sheet
from infra.rendering.engines import Engine
from infra.rendering.flicker import flicker_db, log_error, noise_flicker_db
from infra.rendering.look import Look, shown
from infra.rendering.picture_file import (
    PictureFile,
    Radiance,
    kept_picture,
    request,
    write_picture,
)
from infra.rendering.places import PicturePlaces
from pipeline.documents.png import encode_png
from pipeline.exchange.formats import FORMATS, LoadedScene, SceneSource
from pipeline.exchange.reader import SceneReader
from storage.atomic import write_atomically
from storage.metrics import psnr_log_db
from storage.records.lights import num_lights
from storage.records.scene_file import scene_digest


@dataclass(frozen=True, kw_only=True)
class SceneIdentity:
    """What there is to say of a scene."""

    name: str
    """Its file, without folders."""
    digest: str
    """storage.records.scene_file.scene_digest."""
    num_triangles: int
    """All of them, emitting ones too."""
    num_lights: int
    """Emitter objects."""


@dataclass(frozen=True, kw_only=True)
class Flicker:
    """Of the network's error between two pictures in a row (infra.rendering.flicker)."""

    db: float
    """Higher is calmer."""
    noise_db: float
    """What the noise of the traced pictures alone would show."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frame:
    """What the next picture is compared with."""

    error_RR3: NDArray
    """infra.rendering.flicker.log_error."""
    noise_floor_db: float
    """Of the traced picture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedShot:
    """What came of one shot."""

    scene: SceneIdentity
    """The scene."""
    pictures: Mapping[str, PictureFile]
    """By engine."""
    png: Path
    """What people look at."""
    psnr_log_db: float | None
    """Of the network's picture against the traced one, where there are both."""
    flicker: Flicker | None
    """Since the picture before, of the same scene or stage, where there are both engines."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _OpenScene:
    """The scene of the shots at hand."""

    loaded: LoadedScene
    facts: SceneIdentity
    opened_by: set[str]
    """Engines that have taken it."""


def _is_next_frame(source: SceneSource, before: SceneSource) -> bool:
    """Return whether two sources are moments of one stage; a shard's scenes are strangers."""
    return source.path == before.path and not FORMATS[source.path.suffix.lower()].always_many


class ShotRun:
    """Renders shots one after the other; scenes are read once for shots in a row."""

    def __init__(
        self, engines: Sequence[Engine], place: PicturePlaces, *, view: int, look: Look
    ) -> None:
        """Remember how.

        Args:
            engines: one or both.
            place: where files go.
            view: which of a scene's own cameras is meant.
            look: of the PNG.
        """
        self._engines, self._place = engines, place
        self._view, self._look = view, look
        self._before: _Frame | None = None
        self.notes: dict[str, None] = {}
        """What a person should know, each once, in order."""

    def run(
        self, wanted: Sequence[Shot], reader: SceneReader, done: Callable[[int], None]
    ) -> list[FinishedShot]:
        """Render; `done` hears how many shots are finished. Raises TrilightError."""
        finished, scene = list[FinishedShot](), None
        for index, shot in enumerate(wanted):
            if scene is None or shot.source != wanted[index - 1].source:
                scene = self._read(shot, reader)
                if index and not _is_next_frame(shot.source, wanted[index - 1].source):
                    self._before = None
            finished.append(self._finish(index, shot, scene))
            done(index + 1)
        return finished

    def _read(self, shot: Shot, reader: SceneReader) -> _OpenScene:
        loaded = reader.load(shot.source)
        self.notes |= dict.fromkeys(loaded.notes)
        facts = SceneIdentity(
            name=shot.source.name,
            digest=scene_digest(loaded.scene),
            num_triangles=loaded.scene.num_triangles,
            num_lights=num_lights(loaded.scene),
        )
        return _OpenScene(loaded=loaded, facts=facts, opened_by=set())

    def _finish(self, index: int, shot: Shot, scene: _OpenScene) -> FinishedShot:
        stem = self._place.stem_of(index)
        files, radiances = dict[str, PictureFile](), dict[str, Radiance]()
        for engine in self._engines:
            found = self._picture(engine, stem, shot, scene)
            files[engine.name], radiances[engine.name] = found
        agreement, flicker = None, None
        if len(self._engines) == 1:
            (radiance_rgb,) = radiances.values()
            pixels = shown(radiance_rgb, self._look)
        else:
            traced, neural = radiances["mitsuba"], radiances["neural"]
            agreement = psnr_log_db(neural, traced)
            floor_db = float(files["mitsuba"].facts["noise_floor_db"])
            flicker = self._flicker(log_error(neural, traced), floor_db)
            pixels = comparison_sheet(traced, neural, self._look)
        png = Path(f"{stem}.png")
        write_atomically(png, encode_png(pixels))
        return FinishedShot(
            scene=scene.facts, pictures=files, png=png, psnr_log_db=agreement, flicker=flicker
        )

    def _flicker(self, error_RR3: NDArray, noise_floor_db: float) -> Flicker | None:
        """Compare with the picture before, and be what the next one is compared with."""
        before = self._before
        self._before = _Frame(error_RR3=error_RR3, noise_floor_db=noise_floor_db)
        if before is None:
            return None
        return Flicker(
            db=flicker_db(before.error_RR3, error_RR3),
            noise_db=noise_flicker_db(before.noise_floor_db, noise_floor_db),
        )

    def _exr(self, stem: Path, engine: Engine) -> Path:
        return Path(f"{stem}.exr" if len(self._engines) == 1 else f"{stem}.{engine.name}.exr")

    def _picture(
        self, engine: Engine, stem: Path, shot: Shot, scene: _OpenScene
    ) -> tuple[PictureFile, Radiance]:
        path = self._exr(stem, engine)
        camera = shot.camera or own_camera(scene.loaded.scene, self._view)
        wanted = request(
            engine,
            source=scene.facts.name,
            scene_sha256=scene.facts.digest,
            camera=camera,
            view=None if shot.camera else self._view,
        )
        kept = kept_picture(path, wanted) if self._place.is_sequence else None
        if kept is not None:
            return kept
        if engine.name not in scene.opened_by:
            notes = engine.open(scene.loaded.scene, scene.facts.name)
            self.notes |= dict.fromkeys(notes)
            scene.opened_by.add(engine.name)
        which = f"view {self._view}" if shot.camera is None else f"picture {stem.name}"
        name = f"{scene.facts.name}, {which}"
        return write_picture(path, wanted, engine.render(camera.c2w, camera.fov_deg, name))
