"""Options of `trilight render`."""

from pathlib import Path
from typing import Annotated, Literal

from infra.render.preview_table import Budget
from infra.render.tone_mapping import ToneMap
from pipeline.exchange.from_description import AlbedoOverOne
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
from storage.errors import TrilightError
from storage.metrics import MAX_DB
from storage.settings.described import checked
from storage.settings.ranges import Seed, Within

EngineChoice = Literal["mitsuba", "neural", "both"]
"""Engine of `--engine`: path tracing, a network, or both side by side."""


@checked()
class RenderOptions:
    """Scene, renderer and images."""

    source: str
    """Scene file, or SHARD.tar::KEY; for many, a shard, a folder, or 'NAME{000..119}.json'."""
    out: Path
    """X.exr for one image; a folder, X.mp4 or X.webp for many. A PNG for viewing is written
    beside each EXR, enlarged below 256 pixels; existing images of a folder or video are kept."""
    engine: EngineChoice = "mitsuba"
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
