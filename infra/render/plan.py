"""Plan of one call of `trilight render`: all decisions, before any picture is rendered.

A source may hold many scenes and many cameras. The files of `--out` are one picture, or a folder of
numbered pictures with or without a video. Videos are H.264 in .mp4, which every player reads, or
animated .webp. WebP needs only Pillow and is shown by browsers; MP4 is written by FFmpeg through
PyAV.
"""

import importlib.util
import io
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from infra.render.networks import NetworkRenderer
from infra.render.options import EngineChoice, RenderOptions
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.preview_table import Choice, choose, known_costs, price_all, shipped_table
from infra.render.quality import Budget, FixedSamples, Traced
from infra.render.tone_mapping import Look
from infra.torch_library import require_torch
from pipeline.exchange.formats import readable_suffixes
from pipeline.exchange.reader import SceneReader, SceneSource, scene_source
from pipeline.renders.mitsuba_variant import choose_variant
from storage.atomic import write_atomically, write_error
from storage.dataset.shard_set import expand_pattern
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.records.scene import Scene
from storage.renderer import Camera, Renderer

SUFFIXES = (".mp4", ".webp")
_CRF = "16"
"""Quality of H.264: losses are invisible below about 18, and absent at 0."""

_WEBP_QUALITY = 90
_BT709 = 1
_SRGB = 13
_STUDIO_RANGE = 1
"""Color properties of the video, by their numbers in ITU-T H.273 and in FFmpeg."""


@dataclass(frozen=True, kw_only=True)
class OutputPaths:
    """Paths of the pictures and of the video."""

    stem: Path | None
    """Path of the only picture without its suffix; None for many pictures."""
    folder: Path
    video: Path | None

    @property
    def is_sequence(self) -> bool:
        """True where there may be many pictures."""
        return self.stem is None

    def stem_of(self, index: int) -> Path:
        """Return the path of a picture without its suffix."""
        return self.stem or self.folder / f"{index:06d}"


def output_paths(out: Path) -> OutputPaths:
    """Return the paths that `--out` stands for, and make their folder.

    Raises:
        TrilightError: an unknown suffix, a video without its encoder, or a folder that cannot be
            written.
    """
    suffix = out.suffix.lower()
    if out.is_dir() or not suffix:
        return OutputPaths(stem=None, folder=_writable(out, out), video=None)
    if suffix == ".exr":
        return OutputPaths(stem=out.with_suffix(""), folder=_writable(out.parent, out), video=None)
    if suffix not in SUFFIXES:
        raise TrilightError(
            f"--out is {out}; expected picture.exr, or for many pictures a folder, or X.mp4 or "
            "X.webp, beside which they are kept in a folder X."
        )
    if suffix == ".mp4":
        _av()  # before anything is rendered
    return OutputPaths(stem=None, folder=_writable(out.with_suffix(""), out), video=out)


def _writable(folder: Path, out: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise write_error(out, error) from error
    return folder


def write_video(path: Path, frames: Sequence[Path], fps: int) -> None:
    """Write pictures of equal, even width and height as a video.

    A .webp takes all pictures into memory; an .mp4 one after the other.

    Raises:
        TrilightError: the format needs a missing package, or the file cannot be written.
    """
    encode = _mp4 if path.suffix.lower() == ".mp4" else _webp
    write_atomically(path, encode(frames, fps))


def _iter_frames(frames: Sequence[Path]) -> Iterator[Image.Image]:
    for path in frames:
        with Image.open(path) as picture:
            yield picture.convert("RGB")


def _mp4(frames: Sequence[Path], fps: int) -> bytes:
    av = _av()
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


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise TrilightError(
            "--out X.mp4 needs PyAV, which is not installed: pip install av (it holds x264, GPL), "
            "or choose --out X.webp."
        ) from error
    return av


def scene_sources(text: str, reader: SceneReader) -> list[SceneSource]:
    """Return every scene of a source, in order.

    Args:
        text: one file; `scenes/{000..119}.json` for numbered ones; or a folder, whose scene files
            are sorted by the numbers in their names. A shard stands for all of its samples, an
            animated USD stage for all of its frames.

    Raises:
        TrilightError: a file is unusable, or there is no scene.
    """
    if "://" not in text and Path(text).is_dir():
        paths = [
            path for path in Path(text).iterdir() if path.suffix.lower() in readable_suffixes()
        ]
        if not paths:
            raise TrilightError(
                f"{text}: holds no scene file; expected files that end in "
                f"{' '.join(readable_suffixes())}."
            )
        return [scene_source(str(path)) for path in sorted(paths, key=_by_number)]
    names = expand_pattern(text, "scenes") if "{" in text else [text]
    files = [scene_source(name, many=True) for name in names]
    return [scene for source in files for scene in reader.scenes_of(source)]


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts frame9 before frame10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


def pair_cameras(
    sources: Sequence[SceneSource], cameras: Sequence[Camera | int]
) -> list[tuple[SceneSource, Camera | int]]:
    """Return scene and camera of each picture, in order.

    One scene is combined with all cameras, and one camera with all scenes; equally many scenes and
    cameras are paired. A number is the row of a camera of the scene.

    Raises:
        TrilightError: several scenes and several cameras, but not equally many.
    """
    if len(sources) > 1 and len(cameras) > 1 and len(sources) != len(cameras):
        raise TrilightError(
            f"{len(sources)} scenes and {len(cameras)} cameras; expected one of either, or as many "
            "cameras as scenes."
        )
    count = max(len(sources), len(cameras))
    return [(sources[at % len(sources)], cameras[at % len(cameras)]) for at in range(count)]


def own_camera(scene: Scene, view: int, named: str = "--view") -> Camera:
    """Return a camera of a scene; raises TrilightError, with `named`, if there is no such view."""
    if not 0 <= view < scene.num_views:
        raise TrilightError(
            f"{named} is {view}; expected 0 to {scene.num_views - 1}: the scene has "
            f"{scene.num_views} cameras."
        )
    return Camera.of_scene(scene, view)


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


def camera_path(text: str, reader: SceneReader, view: int) -> list[Camera]:
    """Return the cameras of a file: all of one scene, or one of each frame of an animated stage.

    Args:
        text: JSON file with a list `cameras` as in RenderFormer's scenes, or any scene.
        view: row of the camera in each frame.

    Raises:
        TrilightError: the file is unusable, or has no such camera.
    """
    source = scene_source(text, many=True)
    frames = reader.scenes_of(source)
    if len(frames) > 1:
        return [own_camera(reader.load(frame).scene, view) for frame in frames]
    c2w, fov_deg = reader.cameras(frames[0])
    return [
        Camera(c2w=pose, fov_deg=float(angle)) for pose, angle in zip(c2w, fov_deg, strict=True)
    ]


Pairs = Sequence[tuple[SceneSource, Camera | int]]
"""Scene and camera of each picture; a number is the row of a camera of the scene."""

_RESOLUTION = 512


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
    pairs: Pairs
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
        table = shipped_table()
        costs, source = known_costs(choose_variant("auto"))
        cores = available_cores()
        candidates = price_all(
            table,
            costs,
            width=resolution,
            threads=min(options.threads or cores, cores),
            per_scene=len(pairs) / len({source for source, _ in pairs}),
            network=importlib.util.find_spec("torch") is not None,
        )
        choice = choose(quality, candidates, scenes=table.scenes, costs=source, width=resolution)
        renderers = _renderers(options, choice.priced.samples, None, resolution)
    return RenderPlan(
        source=options.source,
        view=options.view,
        engine=options.engine if choice is None else choice.engine,
        renderers=renderers,
        resolution=resolution,
        look=look,
        output=output,
        pairs=pairs,
        fps=options.fps,
        choice=choice,
    )


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
