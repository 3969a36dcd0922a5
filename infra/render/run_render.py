"""One call of `trilight render`: renders every picture of a plan, or keeps an equal one.

An equal picture is known by the header of its EXR file. Two engines' pictures of one view are
compared side by side, and by the flicker of their error: in motion an error that stays at its
pixels is hardly seen; one that jumps is (storage.metrics.flicker_log_db).

Videos are H.264 in .mp4, which every player reads, or animated .webp. WebP needs only Pillow and is
shown by browsers; MP4 is written by FFmpeg through PyAV.
"""

import dataclasses
import io
import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture
from PIL import ImageDraw, ImageFont

from infra.render.plan import RenderPlan, load_av
from infra.render.tone_mapping import enlarge, tone_mapped
from pipeline.documents.png import encode_png
from pipeline.exchange.formats import FORMATS, SceneSource
from pipeline.exchange.reader import SceneReader
from pipeline.renders.settings import FIRST_SPP
from storage.atomic import write_atomically
from storage.conventions import log10_radiance
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.metrics import flicker_log_db, psnr_log_db
from storage.records.exr import decode_layers, encode_layers, read_header
from storage.records.lights import num_lights, rounded_to_half
from storage.records.safe_read import read_plain
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from storage.renderer import Camera, Fact, Facts, OnProgress, ReadyScene, Renderer
from train.evaluation.sheet import ERROR_WHITE, error_picture

_CRF = "16"
"""Quality of H.264: losses are invisible below about 18, and absent at 0."""

_WEBP_QUALITY = 90
_BT709 = 1
_SRGB = 13
_STUDIO_RANGE = 1
"""Color properties of the video, by their numbers in ITU-T H.273 and in FFmpeg."""

_CAPTION_PX = 24
_GAP_PX = 8
_FONT_PX = 14
_INK = (30, 30, 30)
_PAPER = (250, 250, 248)


def orbit(scene: Scene, start: Camera, count: int, arc_deg: float) -> list[Camera]:
    """Return `count` cameras on a horizontal circle around the point that `start` looks at.

    The circle's center is the point of the camera's axis nearest to the center of all surfaces that
    reflect. The whole circle begins at `start`; a shorter arc has `start` in its middle.
    """
    points = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
    if not len(points):
        points = scene.vertex_positions
    middle = (points.min(axis=0).astype(np.float64) + points.max(axis=0)) / 2
    pose = start.c2w.astype(np.float64)
    eye = pose[:3, 3]
    forward = -pose[:3, 2]
    target = eye + forward * max(float(np.einsum("i,i->", middle - eye, forward)), 0.0)
    if arc_deg == 360:
        angles_deg = 360 * np.arange(count) / count
    else:
        angles_deg = np.linspace(-arc_deg / 2, arc_deg / 2, count) if count > 1 else np.zeros(1)
    cameras = []
    for angle_rad in np.radians(angles_deg):
        cos = np.cos(angle_rad)
        sin = np.sin(angle_rad)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])  # about the vertical axis
        turned = pose.copy()
        turned[:3, :3] = np.einsum("ij,jk->ik", rotation, pose[:3, :3])
        turned[:3, 3] = np.einsum("ij,j->i", rotation, eye - target) + target
        cameras.append(Camera(c2w=turned.astype(np.float32), fov_deg=start.fov_deg))
    return cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Data of one view by both engines, with which the next frame is compared."""

    source: SceneSource
    error_RR3: NDArray
    """[R, R, 3] the network's error of log10(1 + radiance) against the traced picture."""
    noise_floor_db: float
    """Stated error of the traced picture as psnr_log_db."""


def flicker(before: Frame | None, now: Frame) -> Mapping[str, float] | None:
    """Return the change of the network's error between two consecutive frames, at most 100 dB.

    `db` is higher where it is calmer; `noise_db` is that of the traced pictures' noise alone, an
    upper bound for any network. None where the scenes do not belong together.
    """
    if before is None:
        return None
    # one scene or frames of one stage, unlike the scenes of a shard
    is_stage = not FORMATS[now.source.path.suffix.lower()].always_many
    if before.source != now.source and not (is_stage and before.source.path == now.source.path):
        return None
    noise = 10 ** (-before.noise_floor_db / 10) + 10 ** (-now.noise_floor_db / 10)
    noise_db = float(-10 * np.log10(max(noise, 1e-10)))
    return {"db": flicker_log_db(before.error_RR3, now.error_RR3), "noise_db": noise_db}


def captioned_row(tiles: Mapping[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return three pictures of one size side by side, below their captions: [H, W, 3].

    Height and width are even, as videos need them.
    """
    width = len(next(iter(tiles.values())))
    sheet = Picture.new("RGB", (3 * width + 2 * _GAP_PX, width + _CAPTION_PX), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=_FONT_PX)
    for column, (caption, pixels) in enumerate(tiles.items()):
        column_px = column * (width + _GAP_PX)
        sheet.paste(Picture.fromarray(pixels), (column_px, _CAPTION_PX))
        draw.text((column_px + 2, 3), caption, fill=_INK, font=font)
    return np.asarray(sheet)


Radiance = NDArray[np.float32]
"""[R, R, 3] linear radiance."""

_PREFIX = "trilight."
_REQUEST = "request_sha256"


@dataclass(frozen=True, kw_only=True)
class PictureFile:
    """Picture on disk, without its pixels, since a video may have thousands."""

    path: Path
    facts: Facts
    is_black: bool
    seconds: float | None
    """Wall-clock seconds of rendering, those of loading the scene included for its first picture;
    None where an equal file existed already."""


def header_of(
    renderer: Renderer, source: str, scene_sha256: str, camera: Camera
) -> Mapping[str, Fact]:
    """Return the header of a picture, without times and folders: everything that decides it.

    Args:
        source: name of the scene's file, without its folders.
        scene_sha256: digest of the scene by storage.records.scene_file.scene_digest.
    """
    pose: dict[str, Any] = {"c2w": camera.c2w.tolist(), "fov_deg": camera.fov_deg}
    values = {
        "engine": renderer.name,
        "source": source,
        "scene_sha256": scene_sha256,
        "camera": pose if camera.view is None else {**pose, "view": camera.view},
        **renderer.identity,
    }
    plain = {
        name: value if isinstance(value, Fact) else canonical_json(value).decode()
        for name, value in values.items()
    }
    return {**plain, _REQUEST: sha256_hex(canonical_json(values))}


def load_matching_picture(
    path: Path, header: Mapping[str, Fact]
) -> tuple[PictureFile, Radiance] | None:
    """Return the picture in a file if its header matches; else, or if it is unreadable, None."""
    try:
        data = read_plain(path)
        stored = read_header(data)
        if stored.get(_PREFIX + _REQUEST) != header[_REQUEST]:
            return None
        names = {channel.name.rpartition(".")[0] for channel in stored["channels"]}
        radiance_rgb = decode_layers(data, ["", *names - {""}])[0]
    except (OSError, RuntimeError, ValueError, TrilightError):
        return None
    described = {_PREFIX + name for name in header}
    facts = {
        name.removeprefix(_PREFIX): value
        for name, value in stored.items()
        if name.startswith(_PREFIX) and name not in described
    }
    is_black = not radiance_rgb.any()
    return PictureFile(path=path, facts=facts, is_black=is_black, seconds=None), radiance_rgb


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedShot:
    """Result of one shot."""

    png: Path
    scene_sha256: str
    """SHA-256 of the scene by storage.records.scene_file.scene_digest."""
    num_triangles: int
    num_lights: int
    """Number of emitter objects of the scene, not of their triangles."""
    pictures: Mapping[str, PictureFile]
    """Files by the name of their renderer."""
    psnr_log_db: float | None
    """PSNR of the network's picture against the traced one; None without both."""
    flicker: Mapping[str, float] | None
    """Flicker since the preceding picture of the scene or stage; None without both renderers."""


def run_plan(
    plan: RenderPlan,
    reader: SceneReader,
    on_picture: Callable[[int, int], None],
    on_samples: OnProgress,
) -> tuple[list[FinishedShot], list[str]]:
    """Render every picture of a plan, and write the video.

    Args:
        on_picture: called with the number of finished pictures and of all.
        on_samples: called after each pass of the path tracer.

    Returns:
        The pictures, and warnings about scenes and pictures, each once.

    Raises:
        TrilightError: a network or a scene cannot be loaded or rendered, or a file cannot be
            written.
    """
    finished = list[FinishedShot]()
    notes = dict[str, None]()
    before: Frame | None = None
    cameras: Sequence[Camera] = ()
    with ExitStack() as stack:
        for renderer in plan.renderers:
            stack.enter_context(closing(renderer))
        on_picture(0, len(plan.pairs))
        for source, pairs in itertools.groupby(plan.pairs, key=lambda pair: pair[0]):
            loaded = reader.load(source)
            scene = _SceneAtHand(plan, source, loaded.scene, on_samples)
            if plan.orbit is None:
                cameras = ()
            for _, camera in pairs:
                if isinstance(camera, int):
                    if not cameras:
                        start = Camera.of_scene(loaded.scene, plan.view, "--view")
                        cameras = orbit(loaded.scene, start, *plan.orbit) if plan.orbit else [start]
                    camera = cameras[camera]
                stem = plan.output.stem_of(len(finished))
                done, before = scene.finish(stem, camera, before)
                finished.append(done)
                on_picture(len(finished), len(plan.pairs))
            notes |= dict.fromkeys([*loaded.notes, *scene.notes])
    for renderer in plan.renderers:
        notes |= dict.fromkeys(_caveats(renderer, finished))
    if plan.output.video is not None:
        write_video(plan.output.video, [done.png for done in finished], plan.fps)
    return finished, list(notes)


@dataclass(eq=False)
class _SceneAtHand:
    """Scene of consecutive pictures; a renderer loads it for the first one that is not kept."""

    plan: RenderPlan
    source: SceneSource
    scene: Scene
    on_progress: OnProgress

    def __post_init__(self) -> None:
        self.sha256 = scene_digest(self.scene)
        self.notes: list[str] = []
        self.loaded: dict[str, ReadyScene] = {}

    def finish(
        self, stem: Path, camera: Camera, before: Frame | None
    ) -> tuple[FinishedShot, Frame | None]:
        """Write the files of a picture; return it, and the frame if there are both renderers."""
        if camera.view is None:  # of an orbit or a file
            camera = dataclasses.replace(camera, name=f"picture {stem.name}")
        plan = self.plan
        made = {each.name: self._picture(stem, camera, each) for each in plan.renderers}
        files = {name: file for name, (file, _) in made.items()}
        tiles = {
            name: enlarge(tone_mapped(rgb, plan.tone_map, plan.exposure_ev))
            for name, (_, rgb) in made.items()
        }
        now = None
        agreement = None
        if len(made) == 1:
            (pixels,) = tiles.values()
        else:
            traced = made["mitsuba"][1]
            neural = made["neural"][1]
            agreement = psnr_log_db(neural, traced)
            stops = f", {plan.exposure_ev:+g} EV" if plan.exposure_ev else ""
            error = enlarge(error_picture(neural, traced))  # exposure changes no error
            pixels = captioned_row(
                {
                    f"mitsuba{stops}": tiles["mitsuba"],
                    f"neural, {agreement:.1f} dB (log){stops}": tiles["neural"],
                    f"error (white: {ERROR_WHITE} log10)": error,
                }
            )
            now = Frame(
                source=self.source,
                error_RR3=log10_radiance(neural) - log10_radiance(traced),
                noise_floor_db=float(files["mitsuba"].facts["noise_floor_db"]),
            )
        png = Path(f"{stem}.png")
        write_atomically(png, encode_png(pixels))
        finished = FinishedShot(
            png=png,
            scene_sha256=self.sha256,
            num_triangles=self.scene.num_triangles,
            num_lights=num_lights(self.scene),
            pictures=files,
            psnr_log_db=agreement,
            flicker=flicker(before, now) if now else None,
        )
        return finished, now

    def _picture(
        self, stem: Path, camera: Camera, renderer: Renderer
    ) -> tuple[PictureFile, Radiance]:
        """Return the picture of one renderer, from an equal file or rendered.

        Equal headers and pictures give equal bytes.
        """
        plan = self.plan
        path = Path(f"{stem}.{renderer.name}.exr" if len(plan.renderers) > 1 else f"{stem}.exr")
        header = header_of(renderer, self.source.name, self.sha256, camera)
        existing = load_matching_picture(path, header) if plan.output.is_sequence else None
        if existing is not None:
            return existing
        seconds = 0.0
        loaded = self.loaded.get(renderer.name)
        if loaded is None:
            loaded = self.loaded[renderer.name] = renderer.load(self.scene, self.source.name)
            self.notes += [f"{self.source.name}: {note}" for note in loaded.notes]
            seconds = loaded.seconds
        began = time.perf_counter()
        image = loaded.render(camera, self.on_progress)
        seconds += time.perf_counter() - began
        facts = {**image.facts, **(plan.choice.facts if plan.choice else {})}
        named = {_PREFIX + name: value for name, value in {**header, **facts}.items()}
        layers_rgb = {"": image.radiance_rgb, **image.layers_rgb}
        write_atomically(path, encode_layers(layers_rgb, named))
        radiance_rgb = rounded_to_half(image.radiance_rgb)  # as the file holds it
        is_black = not radiance_rgb.any()
        return PictureFile(path=path, facts=facts, is_black=is_black, seconds=seconds), radiance_rgb


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


def write_video(path: Path, frames: Sequence[Path], fps: int) -> None:
    """Write pictures of equal, even width and height as a video.

    A .webp takes all pictures into memory; an .mp4 one after the other.

    Raises:
        TrilightError: the format needs a missing package, or the file cannot be written.
    """
    encode = _mp4 if path.suffix.lower() == ".mp4" else _webp
    write_atomically(path, encode(frames, fps))


def _iter_frames(frames: Sequence[Path]) -> Iterator[Picture.Image]:
    for path in frames:
        with Picture.open(path) as picture:
            yield picture.convert("RGB")


def _mp4(frames: Sequence[Path], fps: int) -> bytes:
    av = load_av()
    stream = io.BytesIO()
    with av.open(stream, "w", format="mp4") as container:
        track: Any = None
        for picture in _iter_frames(frames):
            if track is None:
                track = container.add_stream("libx264", Fraction(fps), options={"crf": _CRF})
                track.width, track.height = picture.size
                track.pix_fmt = "yuv420p"
                track.codec_context.thread_count = 1  # more once gave other bytes
                track.codec_context.colorspace = _BT709  # without it players guess by the size
                track.codec_context.color_primaries = _BT709
                track.codec_context.color_trc = _SRGB
                track.codec_context.color_range = _STUDIO_RANGE
            frame = av.VideoFrame.from_image(picture)
            container.mux(track.encode(frame.reformat(format="yuv420p", dst_colorspace=_BT709)))
        container.mux(track.encode(None))
    return stream.getvalue()


def _webp(frames: Sequence[Path], fps: int) -> bytes:
    first, *remaining = _iter_frames(frames)
    stream = io.BytesIO()
    first.save(
        stream,
        "WEBP",
        save_all=True,
        append_images=remaining,
        duration=round(1000 / fps),
        loop=0,
        quality=_WEBP_QUALITY,
    )
    return stream.getvalue()
