"""Plan of one call of `trilight render`: all decisions, before any picture is rendered.

With it come the files of `--out`: one picture, or a folder of numbered pictures with or without a
video. Videos are H.264 in .mp4, which every player reads, or animated .webp. WebP needs only Pillow
and is shown by browsers; MP4 is written by FFmpeg through PyAV.
"""

import importlib.util
import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image

from infra.render.networks import NetworkRenderer
from infra.render.options import EngineChoice, RenderOptions
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.preview_table import Choice, choose, known_costs, price_all, shipped_table
from infra.render.quality import Budget, FixedSamples, Traced
from infra.render.sources import camera_path, orbit, own_camera, pair_cameras, scene_sources
from infra.render.tone_mapping import Look
from infra.torch_library import require_torch
from pipeline.exchange.open_scene import SceneSource, scene_source
from pipeline.exchange.reader import SceneReader
from pipeline.renders.mitsuba_variant import choose_variant
from storage.atomic import write_atomically, write_error
from storage.errors import TrilightError
from storage.machine import available_cores
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
