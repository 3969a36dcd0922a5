"""`Asked`: what a person asks of a render."""

from pathlib import Path
from typing import Annotated, Literal

from infra.rendering.look import ToneMap
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.renders.preview import MOST_SPP
from pipeline.renders.settings import Filtered, NoiseFloor, Resolution, Samples
from storage.errors import TrilightError
from storage.metrics import MAX_DB
from storage.settings.described import checked
from storage.settings.ranges import Seed, Within

EngineChoice = Literal["mitsuba", "neural", "both"]
"""Path traced, by a network, or by both side by side."""


@checked()
class Asked:
    """What to render, and how."""

    source: str
    """Scene .usda .usdc .usdz .usd, RenderFormer .json or .h5, .safetensors, or SHARD.tar::KEY; for
    many pictures also a shard, a folder of scenes, or 'NAME{000..119}.json'."""
    out: Path
    """X.exr for one picture (a PNG for viewing is written beside it, enlarged below 256 pixels);
    for many a folder, X.mp4 or X.webp, where pictures that exist already are kept."""
    engine: EngineChoice = "mitsuba"
    """Renderer: mitsuba (a path tracer), neural (a network), or both side by side."""
    checkpoint: str | None = None
    """neural: model.safetensors of a run; by default the small network that comes with Trilight."""
    resolution: Resolution | None = None
    """Width of a picture in pixels; by default 512, or with a network of ray bundles the width that
    it was trained on."""
    noise_floor_db: NoiseFloor | None = None
    """mitsuba: sampling stops at this measured noise floor in dB (psnr_log_db; higher is cleaner);
    by default 40, unless another floor is asked for. Of several, all are reached."""
    noise_floor_linear_db: NoiseFloor | None = None
    """mitsuba: sampling stops at this floor as psnr_linear_db, of radiance clamped to [0, 1]: 5 to
    10 dB below psnr_log_db in most pictures. It governs only if given; by default it does not."""
    noise_floor_objects_db: NoiseFloor | None = None
    """mitsuba: sampling stops at this floor as object_psnr_log_db, in which empty background does
    not count. It governs only if given; by default it does not."""
    max_spp: Samples = 4096
    """mitsuba: maximum number of samples per pixel."""
    spp: Annotated[int | None, Within(1, MOST_SPP, unit="samples")] = None
    """mitsuba: a preview of exactly so many samples per pixel and one denoise, whose error is not
    measured; by default sampling goes on to the noise floor."""
    seconds: Annotated[float | None, Within(0, 1e9, low_open=True, unit="seconds")] = None
    """mitsuba: the preview of least expected error that takes so many seconds a picture after
    start-up; by default nothing is chosen by time."""
    error_db: Annotated[float | None, Within(0, MAX_DB, unit="dB")] = None
    """mitsuba: the quickest preview whose expected error is this many dB (psnr_log_db, in the
    median of measured scenes); by default nothing is chosen by it."""
    denoiser: Filtered | None = None
    """mitsuba with --spp: Open Image Denoise with its fast or its high filter, or off; by default
    fast up to 16 samples and high beyond."""
    split: bool = False
    """mitsuba: write direct and indirect light into the EXR as layers as well, whose sum is the
    picture."""
    split_lobes: bool = False
    """mitsuba: write the light of the diffuse and of the specular lobe of the visible surface as
    layers as well; with --split there are four."""
    view: Annotated[int, Within(0, 999)] = 0
    """Number of the scene's camera, counted from 0."""
    orbit: Annotated[int | None, Within(1, 100_000, unit="pictures")] = None
    """Number of pictures from a circle of cameras around the point that the camera looks at; by
    default one picture, from the camera itself."""
    arc_deg: Annotated[float, Within(0, 360, low_open=True, unit="degrees")] = 360.0
    """Angle of the orbit; below 360 the scene's camera is in the middle of the arc."""
    cameras: str | None = None
    """A .json or scene file from each of whose cameras a picture is made; by default only the
    scene's camera is used."""
    fps: Annotated[int, Within(1, 240, unit="pictures a second")] = 24
    """Frames per second of a video."""
    tone_map: ToneMap = "plain"
    """Tone mapping of PNG and video: plain (sRGB, clipped), or filmic (ACES 2.0)."""
    exposure_ev: Annotated[float, Within(-32, 32, unit="stops")] = 0.0
    """Exposure of PNG and video in stops, each of which doubles the brightness; EXR always keeps
    the radiance."""
    precision: Literal["float32", "bfloat16", "tf32", "float16"] = "float32"
    """neural: precision of matrix products; tf32 and float16 need CUDA."""
    lights_per_pass: Annotated[int, Within(1, 65_535, unit="triangles")] = 8
    """neural: maximum number of emitting triangles in one pass; the pictures of the passes are
    added up."""
    albedo_over_one: AlbedoOverOne = "scale"
    """How to treat a material of a RenderFormer scene whose diffuse and specular albedos add up to
    more than 1: scale multiplies both by one factor, refuse leaves the scene out."""
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

    def _require_one_kind(self) -> None:
        """Raise TrilightError where a preview and a measured picture are both asked for."""
        floors = {
            "--noise-floor": self.noise_floor_db,
            "--noise-floor-linear": self.noise_floor_linear_db,
            "--noise-floor-objects": self.noise_floor_objects_db,
            "--split": self.split or None,
            "--split-lobes": self.split_lobes or None,
        }
        asked = [name for name, value in floors.items() if value is not None]
        previews = {"--spp": self.spp, "--seconds": self.seconds, "--error": self.error_db}
        wanted = [(name, value) for name, value in previews.items() if value is not None]
        if self.spp is None and self.denoiser is not None:
            raise TrilightError(f"--denoiser is {self.denoiser}; expected --spp beside it.")
        if not wanted:
            return
        said = "{} is {:g}".format(*wanted[0])
        if asked:
            raise TrilightError(
                f"{said} beside {asked[0]}; expected one of them: a preview measures nothing and "
                "keeps nothing apart."
            )
        if len(wanted) > 1:
            raise TrilightError(f"{said} beside {wanted[1][0]}; expected one of them.")
        if self.engine != "mitsuba":
            raise TrilightError(
                f"{said} beside --engine {self.engine}; expected --engine mitsuba: a network takes "
                "no samples, and a preview is nothing to judge one by."
            )
