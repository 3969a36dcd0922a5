"""Contradictory settings are refused with one line that says what is wrong."""

from typing import Any

import pytest

from pipeline.renders.settings import RenderSettings, one_picture
from storage.errors import TrilightError
from storage.settings.described import from_record, settings_record

GOOD: dict[str, Any] = {
    "resolution": 64, "noise_floor_db": 40.0, "min_spp": 128, "max_spp": 512,
}  # fmt: skip
FLOORS = ("noise_floor_db", "noise_floor_linear_db", "noise_floor_objects_db")


BAD: dict[str, tuple[Any, ...]] = {
    "resolution": (0, 60, 2056),
    "min_spp": (0, 640, 100),
    "max_spp": (130,),
    "aux_spp": (32,),
    "max_depth": (0,),
    "rr_depth": (0,),
    "denoiser": ("best",),
    "min_mean_radiance": (-1.0,),
    **dict.fromkeys(FLOORS, (0.0, -3.0, 101.0, float("nan"), "loud")),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_settings_name_themselves(name: str) -> None:
    for value in BAD[name]:
        with pytest.raises(TrilightError, match=f"{name}.*{value}") as caught:
            RenderSettings(**{**GOOD, name: value})
        assert "\n" not in str(caught.value)


def test_a_narrow_picture_has_more_samples_before_the_first_look() -> None:
    for resolution, max_spp, first in (
        (512, 4096, 64),
        (256, 4096, 64),
        (128, 4096, 64),
        (64, 4096, 128),
        (96, 4096, 128),
        (8, 64, 64),
    ):
        settings = {**GOOD, "resolution": resolution, "min_spp": 64, "max_spp": max_spp}
        assert RenderSettings(**settings).first_spp == first, (resolution, max_spp)


def test_one_target_is_enough_and_one_is_needed() -> None:
    alone = RenderSettings(**{**GOOD, "noise_floor_db": None, "noise_floor_linear_db": 30.0})
    assert alone.targets_db == {"psnr_linear_db": 30.0}
    assert RenderSettings(**GOOD, noise_floor_objects_db=38.0).targets_db == {
        "psnr_log_db": 40.0,
        "object_psnr_log_db": 38.0,
    }
    with pytest.raises(TrilightError, match="noise_floor_db is None; expected one of"):
        RenderSettings(**{**GOOD, "noise_floor_db": None})


def test_a_record_holds_later_targets_only_where_they_are_set() -> None:
    """Else the digest of every build and of every picture would have changed with them."""
    plain = RenderSettings(**GOOD)
    assert not {*settings_record(plain)} & {*FLOORS[1:]}
    for settings in (plain, RenderSettings(**GOOD, noise_floor_linear_db=30.0)):
        assert from_record(RenderSettings, settings_record(settings)) == settings
    more = settings_record(RenderSettings(**GOOD, noise_floor_linear_db=30.0))
    assert more == settings_record(plain) | {"noise_floor_linear_db": 30.0}


def test_a_picture_that_is_asked_for_has_the_targets_that_are_asked_for() -> None:
    common: dict[str, Any] = {"resolution": 64, "max_spp": 512}
    assert one_picture(**common).targets_db == {"psnr_log_db": 40.0}
    linear = one_picture(**common, noise_floor_linear_db=35.0)
    assert linear.targets_db == {"psnr_linear_db": 35.0}
    both = one_picture(**common, noise_floor_db=44.0, noise_floor_objects_db=43.0)
    assert both.targets_db == {"psnr_log_db": 44.0, "object_psnr_log_db": 43.0}
