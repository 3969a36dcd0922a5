"""Plan of one call of `trilight render`: options, and all decisions before any picture is rendered.

A source may hold many scenes and many cameras. The files of `--out` are one picture, or a folder of
numbered pictures with or without a video.
"""

import importlib.util
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.preview_table import Budget, Choice, choose, known_costs, price_all, shipped_table
from infra.render.tone_mapping import ToneMap, load_filmic
from infra.torch_library import require_torch
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.exchange.reader import SceneReader, SceneSource, scene_source
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import MOST_SPP, PreviewSettings, usual_filter
from pipeline.renders.settings import (
    MOST_TRACED_SPP,
    Filtered,
    NoiseFloor,
    RenderSettings,
    Resolution,
    Samples,
    StatedError,
    measured_settings,
)
from storage.atomic import write_error
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.metrics import MAX_DB
from storage.renderer import Camera, Renderer
from storage.settings.described import checked
from storage.settings.ranges import Seed, Within

Pairs = Sequence[tuple[SceneSource, Camera | int]]
"""Scene and camera of each picture. A number counts the cameras around the first scene; without an
orbit, 0 is the scene's own camera."""

_RESOLUTION = 512


@checked()
class RenderOptions:
    """Scene, renderer and images."""

    source: str
    """Scene file, or SHARD.tar::KEY; for many, a shard, a folder, or 'NAME{000..119}.json'."""
    out: Path
    """X.exr for one image; a folder, X.mp4 or X.webp for many. A PNG for viewing is written
    beside each EXR, enlarged below 256 pixels; existing images of a folder or video are kept."""
    engine: Literal["mitsuba", "neural", "both"] = "mitsuba"
    """Renderer: mitsuba (path tracer), neural (network), or both side by side."""
    checkpoint: str | None = None
    """neural: folder or weights of a run, or a published name; by default the included network."""
    resolution: Resolution | None = None
    """Width of an image in pixels; by default 512, or the training width of a pure network."""
    noise_floor_db: NoiseFloor | None = None
    """mitsuba: stop at this stated error (psnr_log_db; higher is cleaner); by default 40, unless
    another target is given. Of several, all are reached."""
    noise_floor_linear_db: NoiseFloor | None = None
    """mitsuba: stop at this stated error as psnr_linear_db (radiance within [0, 1]); by default
    none. In most images it is 5 to 10 dB below psnr_log_db."""
    noise_floor_objects_db: NoiseFloor | None = None
    """mitsuba: stop at this stated error as object_psnr_log_db (without background); by default
    none."""
    max_spp: Samples = MOST_TRACED_SPP
    """mitsuba: maximum average of samples per pixel; the last round may end a little above it."""
    stated_error: StatedError = "calibrated"
    """mitsuba: how the error is stated: calibrated on other scenes, with an expected error; or as a
    bound."""
    spp: Annotated[int | None, Within(1, MOST_SPP, unit="samples")] = None
    """mitsuba: samples per pixel of a preview with one denoise; by default sampling ends at the
    stated error. The error of a preview is not measured."""
    seconds: Annotated[float | None, Within(0, 1e9, low_open=True, unit="seconds")] = None
    """mitsuba: best preview within these seconds per image after start-up; by default none."""
    error_db: Annotated[float | None, Within(0, MAX_DB, unit="dB")] = None
    """mitsuba: fastest preview with this expected median error (psnr_log_db); by default none."""
    denoiser: Filtered | None = None
    """mitsuba with --spp: filter of Open Image Denoise, or off; by default fast up to 16 samples
    and high beyond."""
    split: bool = False
    """mitsuba: also write direct and indirect light as layers. Their errors are less sure."""
    split_lobes: bool = False
    """mitsuba: also write diffuse and specular light as layers; with --split four."""
    view: Annotated[int, Within(0, 999)] = 0
    """Number of the scene's camera, counted from 0."""
    orbit: Annotated[int | None, Within(1, 100_000, unit="images")] = None
    """Number of images from a circle of cameras around the scene; by default its camera alone."""
    arc_deg: Annotated[float, Within(0, 360, low_open=True, unit="degrees")] = 360.0
    """Angle of the orbit; below 360 the scene's camera is its middle."""
    cameras: str | None = None
    """File (.json or a scene) whose cameras are rendered; by default only the scene's camera."""
    fps: Annotated[int, Within(1, 240, unit="images a second")] = 24
    """Frames per second of a video."""
    tone_map: ToneMap = "plain"
    """Tone mapping of PNG and video: plain (sRGB) or filmic (ACES 2.0)."""
    exposure_ev: Annotated[float, Within(-32, 32, unit="stops")] = 0.0
    """Exposure of PNG and video in stops; EXR keeps the radiance."""
    precision: Literal["float32", "bfloat16", "tf32", "float16"] = "float32"
    """neural: precision of matrix products; tf32 and float16 need CUDA."""
    lights_per_pass: Annotated[int, Within(1, 65_535, unit="triangles")] = 8
    """neural: maximum number of emitting triangles in one pass; passes are added."""
    albedo_over_one: AlbedoOverOne = "scale"
    """Scale or refuse RenderFormer materials whose albedos sum to above 1."""
    seed: Seed = 0
    """mitsuba: seed of the samples."""
    threads: Annotated[int | None, Within(1, 1024, unit="threads")] = None
    """Number of CPU threads; by default one for each core."""

    def __post_init__(self) -> None:
        self._require_one_kind()
        if self.orbit is not None and self.cameras is not None:
            raise TrilightError(f"--cameras is {self.cameras}; expected no --orbit beside it.")
        if self.checkpoint is not None and self.engine == "mitsuba":
            raise TrilightError(
                f"--checkpoint is {self.checkpoint}; expected --engine neural or both beside it."
            )
        if (self.split or self.split_lobes) and self.engine == "neural":
            raise TrilightError(
                "--split or --split-lobes is given; expected --engine mitsuba or both beside it, "
                "since a network makes all light together."
            )

    def quality(self, resolution: int) -> RenderSettings | PreviewSettings | Budget:
        """Return the settings of traced images at a width in pixels, or what chooses them.

        Raises:
            TrilightError: a value is invalid; the message names it.
        """
        if self.seconds is not None:
            return Budget("--seconds", self.seconds)
        if self.error_db is not None:
            return Budget("--error", self.error_db)
        if self.spp is not None:
            filtered = self.denoiser or usual_filter(self.spp)
            return PreviewSettings(resolution=resolution, spp=self.spp, denoiser=filtered)
        return measured_settings(
            resolution,
            vars(self),
            max_spp=self.max_spp,
            stated_error=self.stated_error,
            split=self.split,
            split_lobes=self.split_lobes,
        )

    def _require_one_kind(self) -> None:
        """Raise TrilightError where options of a preview and of a measured image are mixed."""
        floors = {
            "--noise-floor": self.noise_floor_db,
            "--noise-floor-linear": self.noise_floor_linear_db,
            "--noise-floor-objects": self.noise_floor_objects_db,
            "--stated-error": None if self.stated_error == "calibrated" else self.stated_error,
            "--split": self.split or None,
            "--split-lobes": self.split_lobes or None,
        }
        measured = [name for name, value in floors.items() if value is not None]
        values = {"--spp": self.spp, "--seconds": self.seconds, "--error": self.error_db}
        preview_options = [(name, value) for name, value in values.items() if value is not None]
        if self.spp is None and self.denoiser is not None:
            raise TrilightError(f"--denoiser is {self.denoiser}; expected --spp beside it.")
        if not preview_options:
            return
        said = "{} is {:g}".format(*preview_options[0])
        if measured:
            raise TrilightError(
                f"{said} beside {measured[0]}; expected one of them: a preview measures nothing, "
                "and stores no layers."
            )
        if len(preview_options) > 1:
            raise TrilightError(f"{said} beside {preview_options[1][0]}; expected one of them.")
        if self.engine != "mitsuba":
            raise TrilightError(
                f"{said} beside --engine {self.engine}; expected --engine mitsuba: a network takes "
                "no samples, and a preview is nothing to judge one by."
            )


@dataclass(frozen=True, kw_only=True)
class OutputPaths:
    """Paths of the pictures and of the video."""

    out: Path
    """Path as the user named it: of the only picture, of the folder of many, or of the video."""
    folder: Path
    video: Path | None = None
    """Path of the video; None without one."""
    is_sequence: bool = True
    """True where there may be many pictures."""

    def stem_of(self, index: int) -> Path:
        """Return the path of a picture without its suffix."""
        return self.folder / f"{index:06d}" if self.is_sequence else self.out.with_suffix("")


def output_paths(out: Path) -> OutputPaths:
    """Return the paths that `--out` stands for; raises TrilightError for an unknown suffix."""
    suffix = out.suffix.lower()
    if out.is_dir() or not suffix:
        return OutputPaths(out=out, folder=out)
    if suffix == ".exr":
        return OutputPaths(out=out, folder=out.parent, is_sequence=False)
    if suffix not in (".mp4", ".webp"):
        raise TrilightError(
            f"--out is {out}; expected picture.exr, or for many pictures a folder, or X.mp4 or "
            "X.webp, beside which they are kept in a folder X."
        )
    return OutputPaths(out=out, folder=out.with_suffix(""), video=out)


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


def pair_cameras(sources: Sequence[SceneSource], cameras: Sequence[Camera | int]) -> Pairs:
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


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderPlan:
    """Pictures, renderers and files of a render, with all defaults resolved."""

    source: str
    """Scene or scenes as the user named them."""
    view: int
    """Row of the scene's camera that the user named."""
    renderers: Sequence[Renderer]
    """One renderer, or the path tracer and the network."""
    resolution: int
    """Width of every picture in pixels."""
    tone_map: ToneMap
    exposure_ev: float
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
    if options.tone_map == "filmic":
        load_filmic()
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
        renderers=renderers,
        resolution=resolution,
        tone_map=options.tone_map,
        exposure_ev=options.exposure_ev,
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
