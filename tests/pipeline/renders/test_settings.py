"""Contradictory settings are refused with one line that says what is wrong."""

from typing import Any

import pytest

from pipeline.renders.settings import RenderSettings
from storage.errors import TrilightError

GOOD: dict[str, Any] = {
    "resolution": 64, "noise_floor_db": 40.0, "min_spp": 128, "max_spp": 512,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("resolution", 0),
        ("resolution", 60),
        ("resolution", 2056),
        ("min_spp", 0),
        ("min_spp", 640),
        ("min_spp", 100),
        ("max_spp", 130),
        ("aux_spp", 32),
        ("max_depth", 0),
        ("rr_depth", 0),
        ("denoiser", "best"),
        ("min_mean_radiance", -1.0),
    ],
)
def test_bad_settings_name_themselves(name: str, value: Any) -> None:
    with pytest.raises(TrilightError, match=f"{name}.*{value}") as caught:
        RenderSettings(**{**GOOD, name: value})
    assert "\n" not in str(caught.value)
