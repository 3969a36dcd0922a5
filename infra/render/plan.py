"""Plan of one call of `trilight render`: all decisions, before any picture is rendered.

A source may hold many scenes and many cameras. The files of `--out` are one picture, or a folder of
numbered pictures with or without a video.
"""

import importlib.util
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from infra.render.networks import NetworkRenderer
from infra.render.options import EngineChoice, RenderOptions
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.preview_table import Budget, Choice, choose, known_costs, price_all, shipped_table
from infra.render.tone_mapping import Look
from infra.torch_library import require_torch
from pipeline.exchange.reader import SceneReader, SceneSource, scene_source
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import PreviewSettings
from pipeline.renders.settings import RenderSettings
from storage.atomic import write_error
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.renderer import Camera, Renderer


@dataclass(frozen=True, kw_only=True)
class OutputPaths:
    """Paths of the pictures and of the video."""

    out: Path
    """Path as the user named it: of the only picture, of the folder of many, or of the video."""
    folder: Path

    @property
    def is_sequence(self) -> bool:
        """True where there may be many pictures."""
        return self.out == self.folder or self.video is not None

    @property
    def video(self) -> Path | None:
        """Path of the video; None without one."""
        is_video = self.out != self.folder and self.out.suffix.lower() != ".exr"
        return self.out if is_video else None

    def stem_of(self, index: int) -> Path:
        """Return the path of a picture without its suffix."""
        return self.folder / f"{index:06d}" if self.is_sequence else self.out.with_suffix("")


def output_paths(out: Path) -> OutputPaths:
    """Return the paths that `--out` stands for; raises TrilightError for an unknown suffix."""
    suffix = out.suffix.lower()
    if out.is_dir() or not suffix:
        return OutputPaths(out=out, folder=out)
    if suffix == ".exr":
        return OutputPaths(out=out, folder=out.parent)
    if suffix not in (".mp4", ".webp"):
        raise TrilightError(
            f"--out is {out}; expected picture.exr, or for many pictures a folder, or X.mp4 or "
            "X.webp, beside which they are kept in a folder X."
        )
    return OutputPaths(out=out, folder=out.with_suffix(""))


def load_av() -> Any:
    """Return the module of PyAV; raises TrilightError without it."""
    try:
        import av
    except ImportError as error:
        raise TrilightError(
            "--out X.mp4 needs PyAV, which is not installed: pip install av (it holds x264, GPL), "
            "or choose --out X.webp."
        ) from error
    return av


def _require_writable(output: OutputPaths) -> None:
    """Refuse what would fail after pictures are rendered; nothing is made that stays."""
    if output.video is not None and output.video.suffix.lower() == ".mp4":
        load_av()
    try:
        folder = next(path for path in (output.folder, *output.folder.parents) if path.exists())
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise write_error(output.out, error) from error


def pair_cameras(
    sources: Sequence[SceneSource], cameras: Sequence[Camera | int]
) -> list[tuple[SceneSource, Camera | int]]:
    """Return scene and camera of each picture, in order.

    One scene is combined with all cameras, and one camera with all scenes; equally many scenes and
    cameras are paired.

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


Pairs = Sequence[tuple[SceneSource, Camera | int]]
"""Scene and camera of each picture. A number counts the cameras around the first scene; without an
orbit, 0 is the scene's own camera."""

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
    orbit: tuple[int, float] | None = None
    """Number of cameras around the first scene, and their angle in degrees; None without them."""
    choice: Choice | None = None
    """Samples or network for a budget, with their expected cost and error; None without one."""


def plan_render(options: RenderOptions, reader: SceneReader) -> RenderPlan:
    """Return the plan of a render, before a file is written.

    Raises:
        TrilightError: an option without effect, an unusable source, camera or checkpoint, or a
            folder that cannot be written.
    """
    output = output_paths(options.out)
    if not output.is_sequence and (options.orbit, options.cameras) != (None, None):
        raise TrilightError(f"--out is {options.out}; expected a folder, X.mp4 or X.webp for many.")
    _require_writable(output)
    look = Look(tone_map=options.tone_map, exposure_ev=options.exposure_ev)
    checkpoint, resolution = _network_and_width(options)
    PreviewSettings(resolution=resolution, spp=1)  # reports a wrong width first
    traced = None if options.engine == "neural" else options.quality(resolution)
    sources = reader.list_scenes(options.source, options.albedo_over_one, many=output.is_sequence)
    if traced is not None:
        choose_variant("auto")  # probed once, and refused before cameras or a scene are read
    cameras: Sequence[Camera | int] = range(options.orbit or 1)
    if options.cameras is not None:
        file = scene_source(options.cameras, many=True)
        cameras = reader.cameras(file, options.view)
    pairs = pair_cameras(sources, cameras)
    renderers, choice = _renderers(options, traced, checkpoint, resolution, pairs)
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
        orbit=None if options.orbit is None else (options.orbit, options.arc_deg),
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
    trained_px = None if network.any_width else network.trained.resolution
    return checkpoint, trained_px or _RESOLUTION


def _renderers(
    options: RenderOptions,
    traced: RenderSettings | PreviewSettings | Budget | None,
    checkpoint: str | None,
    resolution: int,
    pairs: Pairs,
) -> tuple[list[Renderer], Choice | None]:
    """Return the renderers of `--engine`, or of what is chosen for a budget; and that choice."""
    choice = None
    if isinstance(traced, Budget):
        table = shipped_table()
        costs, origin = known_costs(choose_variant("auto"))
        cores = available_cores()
        candidates = price_all(
            table,
            costs,
            width=resolution,
            threads=min(options.threads or cores, cores),
            per_scene=len(pairs) / len({source for source, _ in pairs}),
            network=importlib.util.find_spec("torch") is not None,
        )
        choice = choose(traced, candidates, scenes=table.scenes, costs=origin, width=resolution)
        traced = choice.priced.samples
        if traced is None:
            from model.open import BUILTIN_TOKENS

            checkpoint = BUILTIN_TOKENS
    renderers = list[Renderer]()
    if traced is not None:
        child = RenderChild(choose_variant("auto"), options.threads)
        renderers.append(PathTracer(child, traced, seed=options.seed))
    if checkpoint is not None:
        network = NetworkRenderer(
            checkpoint=checkpoint,
            resolution=resolution,
            lights_per_pass=options.lights_per_pass,
            precision=options.precision,
            threads=options.threads,
        )
        renderers.append(network)
    return renderers, choice
