"""Paths of cameras: where the views of a scene stand, and how evenly."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_templates.families import Family, alone
from scene_templates.sample_camera import CameraPath, CameraSettings, path_position, sample_camera
from scene_templates.settings import SceneSettings
from scene_templates.skies.procedural_skies import SkySettings
from scene_templates.templates import TEMPLATES
from storage.errors import TrilightError
from storage.settings.described import from_record, settings_record
from tests.for_each import for_each
from tests.scene_templates.balls import drawn, template_settings


def _directions(path: CameraPath, count: int, seed: int = 0, **changes: object) -> NDArray:
    """Return the unit directions [count, 3] from which a scene's views see the origin."""
    settings = CameraSettings(path=path, target_jitter=0.0, **changes)  # type: ignore[arg-type]
    rng = np.random.default_rng(seed + 1)
    positions = [
        path_position(path, view, count, np.random.default_rng(seed)) for view in range(count)
    ]
    poses = [sample_camera(rng, settings, TEMPLATES["alone"].cameras, each) for each in positions]
    return np.stack([pose.c2w[:3, 2] for pose in poses])


def _unevenness(directions: NDArray) -> float:
    """Return the mean over many caps of how far the share of views in it is from its area."""
    axes = np.random.default_rng(5).standard_normal((500, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    cosines = np.linspace(-0.9, 0.9, 19)
    inside = (axes @ directions.T)[:, None] > cosines[:, None]
    return float(np.abs(inside.mean(axis=-1) - (1 - cosines) / 2).mean())


@for_each("count", [12, 24, 150])
def test_views_of_a_sphere_are_more_even_than_random_ones(count: int) -> None:
    random = np.mean([_unevenness(_directions("random", count, seed)) for seed in range(8)])
    for path in ("sphere", "fibonacci"):
        even = [_unevenness(_directions(path, count, seed)) for seed in range(8)]
        assert max(even) < random / 2, path


def test_an_orbit_is_a_circle_in_equal_steps() -> None:
    directions = _directions("orbit", 36)
    assert np.ptp(directions[:, 2]) < 1e-12
    azimuth = np.unwrap(np.arctan2(directions[:, 1], directions[:, 0]))
    np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi / 36, atol=1e-12)
    heights = [_directions("orbit", 2, seed)[0, 2] for seed in range(40)]
    assert min(heights) < -0.5 and max(heights) > 0.5, "the elevation is drawn for each scene"


@for_each("path", ["random", "sphere", "fibonacci", "orbit"])
def test_stated_elevations_take_the_place_of_the_layouts(path: CameraPath) -> None:
    heights = _directions(path, 50, elevation_deg=(10.0, 30.0))[:, 2]
    assert np.sin(np.radians(10)) <= heights.min() and heights.max() <= np.sin(np.radians(30))
    if path in ("sphere", "fibonacci"):
        assert np.ptp(heights) > 0.9 * (0.5 - np.sin(np.radians(10)))


def test_a_narrow_sector_holds_its_path() -> None:
    for view in range(30):
        position = path_position("fibonacci", view, 30, np.random.default_rng(0))
        assert position is not None
        x, y, _ = TEMPLATES["corner"].cameras.direction_at(*position)
        assert 180 <= np.degrees(np.arctan2(y, x)) % 360 <= 270


def test_records_of_random_cameras_say_nothing_of_a_path() -> None:
    record = settings_record(CameraSettings())
    assert set(record) == {"distance", "target_jitter", "up_jitter", "fov_deg"}
    orbit = CameraSettings(path="orbit", elevation_deg=(20.0, 20.0))
    assert from_record(CameraSettings, settings_record(orbit)) == orbit


def test_an_object_alone_stands_in_the_middle() -> None:
    settings = SceneSettings(families=(alone(),))
    settings = dataclasses.replace(
        settings, placement=dataclasses.replace(settings.placement, orientation="kept")
    )
    for one in drawn(settings, 10):
        (placement,) = one.layout.objects
        assert one.layout.shell == ()
        assert not placement.pose.centre.any() and placement.pose.radius == 0.5
        assert np.array_equal(placement.pose.rotation, np.eye(3))


def test_a_layout_without_a_room_holds_one_object() -> None:
    with pytest.raises(TrilightError, match=r"\(1, 2\); expected \(1, 1\) for alone"):
        Family(**{**vars(alone()), "num_objects": (1, 2)})


def test_no_lamps_need_a_sky_in_every_scene() -> None:
    settings = template_settings("plane")
    dark = dataclasses.replace(settings.lights, count=(0, 3))
    with pytest.raises(TrilightError, match=r"lights.count is \(0, 3\); expected at least 1, or"):
        dataclasses.replace(settings, lights=dark, skies=SkySettings(share=0.9))
    dataclasses.replace(settings, lights=dark, skies=SkySettings(share=1.0))
