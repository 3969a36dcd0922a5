"""Quality of a picture: a measured error, a number of samples, or a budget that chooses them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.renders.preview import PreviewSettings
from pipeline.renders.settings import (
    CALIBRATED_LOOKS,
    FIRST_SPP,
    USUAL_FLOOR_DB,
    Filtered,
    RenderSettings,
    StatedError,
    Targets,
    target_overrides,
)

MOST_TRACED_SPP = 4096
"""Default maximum number of samples per pixel."""


@dataclass(frozen=True, kw_only=True)
class ToStatedError:
    """Samples until the measured error reaches its targets."""

    targets: Targets = field(default_factory=dict)
    """Target errors; psnr_log_db of 40 where none is set."""
    max_spp: int = MOST_TRACED_SPP
    split: bool = False
    """True to keep direct and indirect light apart."""
    split_lobes: bool = False
    """True to keep diffuse and specular light apart."""
    max_depth: int = RenderSettings.max_depth
    """Maximum length of a path in edges; 2 is direct light."""
    stated_error: StatedError = "calibrated"

    def settings(self, resolution: int) -> RenderSettings:
        """Return the settings at a width in pixels, of a picture that may be dark.

        Raises:
            TrilightError: a value is invalid; the message names it.
        """
        targets = target_overrides(self.targets) or {"noise_floor_db": USUAL_FLOOR_DB}
        is_bound = self.stated_error == "bound"
        looks: Mapping[str, Any] = {"min_spp": FIRST_SPP} if is_bound else CALIBRATED_LOOKS
        return RenderSettings(
            resolution=resolution,
            max_spp=self.max_spp,
            max_depth=self.max_depth,
            min_mean_radiance=0.0,
            split=self.split,
            split_lobes=self.split_lobes,
            arithmetic="device",
            **{**targets, **looks, "min_spp": min(looks["min_spp"], self.max_spp)},
        )


@dataclass(frozen=True, kw_only=True)
class FixedSamples:
    """A number of samples and one denoise, of unmeasured error."""

    spp: int
    """Number of paths through each pixel, from 1."""
    denoiser: Filtered

    @property
    def count(self) -> str:
        """The number of samples as text, such as `4 samples`."""
        return f"{self.spp} sample{'s' if self.spp > 1 else ''}"

    def __str__(self) -> str:
        """Return samples and filter as text."""
        return f"{self.count} a pixel, filter {self.denoiser}"

    def settings(self, resolution: int) -> PreviewSettings:
        """Return the settings at a width in pixels; raises TrilightError if it is invalid."""
        return PreviewSettings(resolution=resolution, spp=self.spp, denoiser=self.denoiser)


@dataclass(frozen=True)
class Budget:
    """The least expected error in some seconds a picture, or the least time to a median error."""

    option: Literal["--seconds", "--error"]
    limit: float
    """Wall-clock seconds a picture, or dB of psnr_log_db."""

    def __str__(self) -> str:
        """Return the option of the command line."""
        return f"{self.option} {self.limit:g}"


Traced = ToStatedError | FixedSamples
Quality = Traced | Budget
