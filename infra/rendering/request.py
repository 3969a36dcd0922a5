"""`Asked`: what a person asks of a render."""

from pathlib import Path
from typing import Annotated, Literal

from infra.rendering.look import ToneMap
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.renders.settings import NoiseFloor, Resolution, Samples
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Seed, Within

EngineChoice = Literal["mitsuba", "neural", "both"]
"""Path traced, by a network, or by both side by side."""


@checked()
class Asked:
    """What is rendered, and how."""

    source: str
    """Scene .usda .usdc .usdz .usd, RenderFormer .json or .h5, .safetensors, or SHARD.tar::KEY; for
    many pictures also a shard, a folder of scenes, or 'NAME{000..119}.json'."""
    out: Path
    """X.exr for one picture (X.png is written beside it for looking, enlarged below 256 pixels); a
    folder, X.mp4 or X.webp for many: numbered, and kept where they are there already."""
    engine: EngineChoice = "mitsuba"
    """Path traced by Mitsuba, by a network, or both side by side."""
    checkpoint: str | None = None
    """neural: model.safetensors of a run; by default the small network that is shipped."""
    resolution: Resolution | None = None
    """Width of a picture in pixels; by default 512, or with a network what it was trained on."""
    noise_floor_db: NoiseFloor | None = None
    """mitsuba: sampling stops at this measured noise floor in dB (psnr_log_db; higher is cleaner);
    by default 40, unless another floor is asked for. Of several, all are reached."""
    noise_floor_linear_db: NoiseFloor | None = None
    """mitsuba: sampling stops at this floor as psnr_linear_db, of radiance clamped to [0, 1]: 5 to
    10 dB below psnr_log_db in most pictures."""
    noise_floor_objects_db: NoiseFloor | None = None
    """mitsuba: sampling stops at this floor as object_psnr_log_db, in which empty background does
    not count."""
    max_spp: Samples = 4096
    """mitsuba: most samples per pixel."""
    view: Annotated[int, Within(0, 999)] = 0
    """Which camera of the scene, from 0."""
    orbit: Annotated[int | None, Within(1, 100_000, unit="pictures")] = None
    """Number of pictures on a circle around what the camera sees; by default one from the
    camera."""
    arc_deg: Annotated[float, Within(0, 360, low_open=True, unit="degrees")] = 360.0
    """Angle of the orbit; below 360 the camera stands at its middle."""
    cameras: str | None = None
    """A picture from each camera of this .json or scene; by default from that of the scene."""
    fps: Annotated[int, Within(1, 240, unit="pictures a second")] = 24
    """Pictures a second of a video."""
    tone_map: ToneMap = "plain"
    """Tone mapping of PNG and video: plain (sRGB, clipped), or filmic (ACES 2.0)."""
    exposure_ev: Annotated[float, Within(-32, 32, unit="stops")] = 0.0
    """Stops by which PNG and video are brightened, or darkened below 0: each doubles the light; EXR
    keeps radiance as it is."""
    precision: Literal["float32", "bfloat16", "tf32", "float16"] = "float32"
    """neural: precision of products; tf32 and float16 need CUDA."""
    lights_per_pass: Annotated[int, Within(1, 65_535, unit="triangles")] = 8
    """neural: most emitting triangles at once; groups are added up."""
    skip_empty_bundles: bool = False
    """neural: leave black what no triangle reaches, which is faster and less exact."""
    albedo_over_one: AlbedoOverOne = "scale"
    """What to do with a material of a RenderFormer scene whose diffuse and specular albedos add up
    to more than 1: scale multiplies both by one number, refuse leaves the scene out."""
    seed: Seed = 0
    """mitsuba: seed of the samples."""
    threads: Annotated[int | None, Within(1, 1024, unit="threads")] = None
    """Threads of the processor; by default as many as there are cores."""

    def __post_init__(self) -> None:
        if self.orbit is not None and self.cameras is not None:
            raise TrilightError(f"--cameras is {self.cameras}; expected no --orbit beside it.")
        if self.checkpoint is not None and self.engine == "mitsuba":
            raise TrilightError(
                f"--checkpoint is {self.checkpoint}; expected --engine neural or both beside it."
            )
