"""`RenderSettings`: how good a picture must be, and how much it may cost."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.metrics import MAX_DB
from storage.records.lights import part_names
from storage.settings.described import checked, leaves_out
from storage.settings.ranges import Within

Filtered = Literal["high", "fast", "off"]
"""Quality of Open Image Denoise, or no denoiser."""

PASS_SPP = (64, 16, 4)
"""Samples per pixel of one pass of a half, from best to cheapest: squares, as the sampler needs.

A pass of 64 is stratified finer than four of 16: 0.1 to 0.3 dB less error on sampled scenes, and 1
to 2 dB in the median pixel of the easy ones (study S3). The small ones are for quick previews.
"""

FIRST_SPP = 64
"""Samples of a picture before its bound is measured. With 32, in pictures of 256 pixels, 5 of 50
bounds that were reached at once were over 1 dB too good: no sample had met a glint (study S17)."""

MAX_RESOLUTION = 2048
"""Largest picture: one pass of 64 samples takes 3.3 GB there, and that grows with the area."""

MAX_SPP = 1 << 20
"""Most samples per pixel: at 1.4 dB a doubling, eight times as many as 54 dB take in hard views."""

Resolution = Annotated[int, Within(8, MAX_RESOLUTION, unit="pixels")]
"""Width of a square picture."""

NoiseFloor = Annotated[float, Within(0, MAX_DB, low_open=True, high_open=True, unit="dB")]
"""A target for the measured error of a picture."""

USUAL_FLOOR_DB = 40.0
"""psnr_log_db of a picture that a person asks for without any target."""

MOST_TRACED_SPP = 4096
"""Default maximum number of samples per pixel."""

_METRICS = {
    "noise_floor_db": "psnr_log_db",
    "noise_floor_linear_db": "psnr_linear_db",
    "noise_floor_objects_db": "object_psnr_log_db",
}
"""The metric of each target (storage.metrics)."""

LightPaths = Literal["view", "scene"]
"""Whose light paths a view has: its own, or those of all views of its scene."""

StatedError = Literal["bound", "calibrated"]
"""How errors are stated."""

Arithmetic = Literal["numpy", "device"]
"""Where the pictures of a view are worked out."""

CALIBRATED_LOOKS: Mapping[str, Any] = {
    "stated_error": "calibrated",
    "min_spp": FIRST_SPP // 2,
    "min_spp_px": 256,
    "picture_within_db": 2.0,
}
"""Settings of a calibrated stated error, whose first look needs half the samples of a bound's."""

Samples = Annotated[int, Within(2 * PASS_SPP[-1], MAX_SPP, unit="samples")]
"""Of both halves of a picture together, per pixel."""

Depth = Annotated[int, Within(1, 1024, unit="edges")]
"""Length of a path."""


@checked("render settings")
class RenderSettings:
    """The target, the budget and the estimator of every picture of a preset."""

    resolution: Resolution
    """Width and height in pixels, a multiple of 8 up to MAX_RESOLUTION."""
    noise_floor_db: NoiseFloor | None
    """Sampling goes on until the measured floor (psnr_log_db) reaches this; none where only the
    other two count."""
    noise_floor_linear_db: NoiseFloor | None = None
    """Sampling also goes on until the floor as psnr_linear_db reaches this: that of radiance
    clamped to [0, 1], 5 to 10 dB below psnr_log_db in most pictures."""
    noise_floor_objects_db: NoiseFloor | None = None
    """Sampling also goes on until the floor as object_psnr_log_db reaches this: that of pixels
    which show geometry, so that empty background does not count."""
    min_spp: Samples
    """Samples per pixel, both halves together, before the floor of a picture of `min_spp_px` pixels
    or more is measured first; a smaller one takes as many times more as it is narrower, up to
    `max_spp`: 128 at 64 pixels for 64 at 128, since fewer pixels meet fewer of the rare bright
    paths."""
    max_spp: Samples
    """The cap: sampling stops here whatever the floors are. It bounds the mean over the pixels that
    show anything; those that need most may get twice as many."""
    reject_at_cap: bool = False
    """Reject a view that misses one of its floors at the cap (floor_not_reached; its camera is
    tried again), after all of its samples, instead of keeping it with the floors that it has. A set
    without its hard views is another distribution: keep them unless every picture must be good."""
    max_depth: Depth = 10
    """Longest path in edges: 1 sees emitters alone, 2 adds direct light."""
    rr_depth: Depth = 2
    """Depth in edges from which Russian roulette may end a path. 2 instead of 5 takes 20 % less
    time for the same error on sampled scenes (study S2)."""
    aux_spp: Annotated[int, Within(PASS_SPP[-1], PASS_SPP[0], unit="samples")] = 16
    """Rays per pixel for the albedo and normal pictures that guide the denoiser, on a regular grid.
    16 cost a quarter of 64 and are 0.06 dB worse at 256 samples; pictures beyond 60 dB want 64."""
    denoiser: Filtered = "high"
    """Quality of Open Image Denoise; `fast` costs 1 to 2 dB and saves 0.3 CPU seconds."""
    min_mean_radiance: Annotated[float, Within(0, HALF_FLOAT_MAX)] = 0.01
    """A view whose first samples are darker than this on average is rejected as black_view."""
    per_light: bool = False
    """Render each emitter and the sky alone as well, each with its floors, and make the picture
    their sum (storage.records.lights). It takes about as many times as long as there are lights."""
    split: bool = False
    """Store direct light (lamp, surface, camera) and indirect light apart as well, each with its
    floors, and make the picture their sum (storage.records.lights)."""
    split_lobes: bool = False
    """Store what the diffuse and what the specular lobe of the visible surface reflects apart as
    well; with `split` there are four parts."""

    min_spp_px: Resolution = 128
    """Width in pixels from which `min_spp` samples of each tell the error of a picture."""
    light_paths: LightPaths = "view"
    """`scene` traces the light paths of a preset once for all views of a scene: their errors go
    together, and each alone is what it was."""
    arithmetic: Arithmetic = "numpy"
    """Where means, corrections and stated errors are worked out: `device` keeps pictures where they
    are traced; `numpy` keeps the bytes of sets from before there was a choice."""
    stated_error: StatedError = "bound"
    """How errors are stated: `calibrated` by six measures and their record on other scenes
    (pipeline.renders.calibrated_error), within its range; `bound` by estimate and allowances."""
    picture_within_db: Annotated[float, Within(0, MAX_DB, unit="dB")] | None = None
    """Where the bound by the halves misses a target by more than this, sampling goes on by it,
    without a picture to calibrate the error by; None takes a picture each time."""

    _record = leaves_out(
        "noise_floor_linear_db", "noise_floor_objects_db", "split", "split_lobes", "arithmetic",
        "min_spp_px", "light_paths", "stated_error", "picture_within_db",
    )  # fmt: skip

    def __post_init__(self) -> None:
        unit = 2 * PASS_SPP[-1]
        spp = f"min_spp is {self.min_spp} and max_spp {self.max_spp}; expected"
        best = f"and a cap of a multiple of {2 * PASS_SPP[0]} for the best sampling"
        laws = {
            f"resolution is {self.resolution}; expected a multiple of 8": self.resolution % 8 == 0,
            f"{spp} min <= max": self.min_spp <= self.max_spp,
            f"{spp} multiples of {unit}, {best}": not (self.min_spp % unit or self.max_spp % unit),
            f"aux_spp is {self.aux_spp}; expected one of {PASS_SPP}": self.aux_spp in PASS_SPP,
            f"noise_floor_db is None; expected one of {', '.join(_METRICS)} to be a number": bool(
                self.targets_db
            ),
        }
        for complaint, holds in laws.items():
            if not holds:
                raise TrilightError(f"render settings: {complaint}.")

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the parts that are stored (storage.records.lights); empty where none are."""
        return part_names(bounces=self.split, lobes=self.split_lobes)

    @property
    def targets_db(self) -> dict[str, float]:
        """The targets that are set, in dB by metric: sampling ends when all of them are reached."""
        targets = {metric: getattr(self, name) for name, metric in _METRICS.items()}
        return {metric: db for metric, db in targets.items() if db is not None}


Targets = Mapping[str, float | None]
"""Target errors of a picture in dB by their field of RenderSettings. Those that are set are all
reached, or the cap is."""


def target_overrides(stated: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the targets among stated values, None for others; empty if no target is set."""
    targets = {name: stated.get(name) for name in _METRICS}
    return {} if set(targets.values()) == {None} else targets


def measured_settings(
    resolution: int,
    targets: Targets,
    *,
    max_spp: int = MOST_TRACED_SPP,
    max_depth: int = RenderSettings.max_depth,
    split: bool = False,
    split_lobes: bool = False,
    stated_error: StatedError = "calibrated",
) -> RenderSettings:
    """Return the settings of a picture, which may be dark, that is sampled to a measured error.

    Args:
        resolution: width in pixels.
        targets: target errors; psnr_log_db of 40 where none is set.
        max_depth: maximum length of a path in edges; 2 is direct light.
        split: keep direct and indirect light apart.
        split_lobes: keep diffuse and specular light apart.

    Raises:
        TrilightError: a value is invalid; the message names it.
    """
    looks: Mapping[str, Any] = CALIBRATED_LOOKS
    if stated_error == "bound":
        looks = {"min_spp": FIRST_SPP}
    goals = target_overrides(targets) or {"noise_floor_db": USUAL_FLOOR_DB}
    return RenderSettings(
        resolution=resolution,
        max_spp=max_spp,
        max_depth=max_depth,
        min_mean_radiance=0.0,
        split=split,
        split_lobes=split_lobes,
        arithmetic="device",
        **{**goals, **looks, "min_spp": min(looks["min_spp"], max_spp)},
    )
