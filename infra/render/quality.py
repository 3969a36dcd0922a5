"""Quality of traced pictures: settings to a measured error, and budgets that choose samples."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.renders.settings import (
    CALIBRATED_LOOKS,
    FIRST_SPP,
    USUAL_FLOOR_DB,
    RenderSettings,
    StatedError,
    Targets,
    target_overrides,
)

MOST_TRACED_SPP = 4096
"""Default maximum number of samples per pixel."""


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


def samples_text(spp: int) -> str:
    """Return a number of samples as text, such as `4 samples`."""
    return f"{spp} sample{'s' if spp > 1 else ''}"


@dataclass(frozen=True)
class Budget:
    """The least expected error in some seconds a picture, or the least time to a median error."""

    option: Literal["--seconds", "--error"]
    limit: float
    """Wall-clock seconds a picture, or dB of psnr_log_db."""

    def __str__(self) -> str:
        """Return the option of the command line."""
        return f"{self.option} {self.limit:g}"
