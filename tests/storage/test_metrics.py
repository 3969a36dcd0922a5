"""Frames, units, metrics and intervals, against what is known on paper."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.conventions import (
    camera_rays,
    focal_px,
    in_camera,
    log10_radiance,
    look_at_c2w,
    pixel_places,
    preview_srgb8,
    radiance_from_log10,
    srgb8,
)
from storage.metrics import (
    MAX_DB,
    mean_interval,
    object_psnr_log_db,
    pepper,
    psnr_linear_db,
    psnr_log_db,
    seam,
)

angles = st.floats(1, 170)


def test_a_camera_looks_along_minus_z_with_y_up() -> None:
    c2w = look_at_c2w(eye=[0, -3, 0], target=[0, 0, 0], up=[0, 0, 1])
    assert np.allclose(c2w @ [0, 0, -1, 0], [0, 1, 0, 0])
    assert np.allclose(c2w @ [0, 1, 0, 0], [0, 0, 1, 0])
    assert np.allclose(c2w @ [1, 0, 0, 0], [1, 0, 0, 0])


@given(fov_deg=angles, resolution=st.integers(2, 64))
def test_the_outer_pixel_edges_span_the_field_of_view(fov_deg: float, resolution: int) -> None:
    half_width = 0.5 * resolution / focal_px(fov_deg, resolution)
    assert np.isclose(2 * np.degrees(np.arctan(half_width)), fov_deg)


@given(fov_deg=angles)
def test_rays_are_unit_and_turn_with_the_picture(fov_deg: float) -> None:
    c2w = look_at_c2w(eye=[1, 2, 3], target=[0, 0, 0], up=[0, 0, 1])
    origin, directions = camera_rays(c2w, fov_deg, 8)
    assert np.allclose(origin, [1, 2, 3])
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    up, right = c2w[:3, 1], c2w[:3, 0]
    assert (np.diff(directions @ up, axis=0) < 0).all()  # row 0 is the top
    assert (np.diff(directions @ right, axis=1) > 0).all()
    middle = directions[3:5, 3:5].mean(axis=(0, 1))
    assert np.allclose(middle / np.linalg.norm(middle), -c2w[:3, 2])
    _, rows = camera_rays(c2w, fov_deg, 8, slice(2, 5))
    assert np.allclose(rows, directions[2:5], rtol=0, atol=1e-15)


@given(angles)
def test_places_in_the_picture_invert_the_rays(fov_deg: float) -> None:
    c2w = look_at_c2w(eye=[1, 2, 3], target=[0, 0.5, 0], up=[0, 0, 1])
    c2w[:3, :3] *= 1 + 1e-5  # as far from a rotation as float32 poses that passed through files
    origin, rays = camera_rays(c2w, fov_deg, 7)
    row, column = np.indices((7, 7))
    centres = np.stack([column, row], axis=-1) + 0.5
    for distance in (0.1, 30):
        points = origin + distance * rays
        assert np.allclose(pixel_places(points, c2w, fov_deg, 7), centres, atol=1e-9)
        assert (in_camera(points, c2w)[..., 2] < 0).all()
    assert np.isnan(pixel_places(origin - rays, c2w, fov_deg, 7)).all()
    assert np.isnan(pixel_places(origin, c2w, fov_deg, 7)).all()


@given(st.floats(0, 6e4))
def test_the_output_space_is_inverted(radiance: float) -> None:
    # float64 rounding grows with the exponent: relative 1e-12 plus what 1 + L loses near 0
    assert np.isclose(radiance_from_log10(log10_radiance(radiance)), radiance, 1e-12, 1e-15)


def test_a_preview_is_monotone_ends_at_white_and_has_known_values() -> None:
    ramp = np.linspace(0, 2, 200)[:, None, None]
    preview = preview_srgb8(ramp).astype(int).ravel()
    assert preview[0] == 0
    assert (np.diff(preview) >= 0).all()
    assert (preview[100:] == 255).all()  # radiance 1 and above
    # 0.2140 is what IEC 61966-2-1 gives for code 127.5 of 255; the first piece ends at 0.0031308
    assert srgb8([-1, 0, 0.003, 0.2140, 1, 7]).tolist() == [0, 0, 10, 127, 255, 255]


def test_a_decade_is_zero_db_a_tenth_twenty_and_equal_pictures_are_capped() -> None:
    assert psnr_log_db(np.full((4, 4, 3), 9.0), np.full((4, 4, 3), 99.0)) == pytest.approx(0)
    picture = np.random.default_rng(0).random((8, 8, 3)) * 10
    brighter = (1 + picture) * 10**0.1 - 1
    assert psnr_log_db(picture, brighter) == pytest.approx(20)
    assert psnr_log_db(picture, picture) == MAX_DB
    a, b = np.random.default_rng(1).random((2, 6, 6, 3)) * 100
    for psnr in (psnr_log_db, psnr_linear_db):
        assert psnr(a, b) == psnr(b, a)


def test_linear_sees_nothing_above_one() -> None:
    # Twelve and seven: one side clamped elsewhere would still pass with a value of 1 on the other.
    assert psnr_linear_db(np.full(9, 12.0), np.full(9, 7.0)) == MAX_DB
    assert psnr_linear_db(np.full(9, 0.5), np.full(9, 0.6)) == pytest.approx(20)


def test_background_earns_nothing() -> None:
    hits = np.zeros((10, 10), bool)
    hits[0, 0] = True
    a, b = np.zeros((10, 10, 3)), np.zeros((10, 10, 3))
    b[0, 0] = 9
    assert object_psnr_log_db(a, b, hits) == pytest.approx(0)
    assert psnr_log_db(a, b) == pytest.approx(20)  # a hundredth of the pixels: 20 dB for nothing


def test_the_interval_of_a_mean_goes_by_clusters() -> None:
    """Ten scenes of which each has the same figure 8 times know no more than ten figures."""
    figures = [float(scene < 3) for scene in range(10) for _ in range(8)]
    clusters = [f"scene {scene}" for scene in range(10) for _ in range(8)]
    low, high = mean_interval(figures, clusters)
    alone_low, alone_high = mean_interval(figures, [str(n) for n in range(80)])
    assert low < alone_low < 0.3 < alone_high < high
    assert low == pytest.approx(0.3 - 1.96 * np.sqrt(0.3 * 0.7 / 10), abs=0.06)
    assert mean_interval([0.5] * 4, ["a", "a", "b", "b"]) == (0.5, 0.5)


def _smooth_picture() -> np.ndarray:
    ramp = np.linspace(0.2, 1.5, 64)
    return np.stack([ramp[:, None] * ramp] * 3, axis=-1)


def test_pepper_is_noise_and_not_a_smooth_error() -> None:
    picture = _smooth_picture()
    rng = np.random.default_rng(0)
    peppers = [
        pepper(
            radiance_from_log10(log10_radiance(picture) + rng.normal(0, rms, picture.shape)),
            picture,
        )
        for rms in (0.01, 0.02)
    ]
    assert 0.007 < peppers[0] < 0.01, "the standard deviation over nine pixels, of their mean"
    assert 1.9 < peppers[1] / peppers[0] < 2.1
    offset = radiance_from_log10(log10_radiance(picture) + 0.1)
    assert pepper(offset, picture) < 1e-6
    blurred = np.full_like(picture, picture.mean())
    assert pepper(blurred, picture) == 0


def test_seams_are_steps_between_tiles() -> None:
    picture = _smooth_picture()
    noise = np.random.default_rng(0).normal(0, 0.01, picture.shape)
    noisy = radiance_from_log10(log10_radiance(picture) + noise)
    assert seam(noisy, picture) == pytest.approx(1, abs=0.05)
    for tile, steps in ((4, True), (8, True), (3, False)):
        number = np.arange(64) // tile
        tiles = ((number[:, None] + number) % 2)[..., None] * 0.02
        tiled = radiance_from_log10(log10_radiance(picture) + noise + tiles)
        assert (seam(tiled, picture) > 1.2) == steps, tile
    assert seam(picture, picture) == 1
    assert seam(noisy[:8, :8], picture[:8, :8]) > 0, "tiles of a pixel have nothing inside"
