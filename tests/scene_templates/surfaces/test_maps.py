"""Finishes mix by area, and split light between two lobes."""

import numpy as np
import pytest

from scene_templates.surfaces.maps import MOST_ALBEDO, finish, surface_maps

RED = finish((0.8, 0.1, 0.0), specular_share=0.25, roughness=0.6, metal=False)
GOLD = finish((0.9, 0.7, 0.3), specular_share=0.9, roughness=0.2, metal=True)


def test_the_specular_lobe_is_grey_but_for_metal() -> None:
    # products of two or three numbers, rounded to float64
    np.testing.assert_allclose(RED.diffuse_rgb, [0.6, 0.075, 0.0], rtol=1e-15)
    np.testing.assert_allclose(RED.specular_rgb, [0.25, 0.25, 0.25], rtol=1e-15)
    np.testing.assert_allclose(GOLD.diffuse_rgb, [0.09, 0.07, 0.03], rtol=1e-14)
    np.testing.assert_allclose(GOLD.specular_rgb, [0.81, 0.63, 0.27], rtol=1e-15)


def test_nothing_reflects_more_than_it_receives() -> None:
    white = finish((1.0, 1.0, 2.0), specular_share=1.0, roughness=0.5, metal=False)
    assert (white.diffuse_rgb + white.specular_rgb).max() < 1
    assert white.specular_rgb.max() == MOST_ALBEDO


def test_covering_is_a_mean_of_areas() -> None:
    half = RED.covered(GOLD, np.array([[0.0, 1.0], [0.5, 0.5]]))
    np.testing.assert_array_equal(half.diffuse_rgb[0, 0], RED.diffuse_rgb)
    np.testing.assert_allclose(half.specular_rgb[0, 1], GOLD.specular_rgb, rtol=1e-15)
    np.testing.assert_allclose(
        half.diffuse_rgb[1, 0], (RED.diffuse_rgb + GOLD.diffuse_rgb) / 2, rtol=1e-15
    )
    # GGX widths 0.36 and 0.04 have the mean 0.2
    assert half.roughness[1, 1] == pytest.approx(0.2**0.5, rel=1e-15)


def test_tones_darken_one_lobe_or_both() -> None:
    toned, dimmed = RED.toned(0.5), RED.dimmed(0.5)
    np.testing.assert_array_equal(toned.specular_rgb, RED.specular_rgb)
    np.testing.assert_array_equal(dimmed.specular_rgb, RED.specular_rgb / 2)
    np.testing.assert_array_equal(toned.diffuse_rgb, dimmed.diffuse_rgb)
    np.testing.assert_array_equal(RED.toned(7.0).diffuse_rgb, RED.diffuse_rgb)
    np.testing.assert_array_equal(RED.toned(-1.0).diffuse_rgb, np.zeros(3))


def test_a_constant_finish_is_a_constant_map() -> None:
    maps = surface_maps("one", RED.rougher(0.7), size=4, roughness_clip=(0.05, 0.9), parameters={})
    assert maps.diffuse_rgb.shape == (4, 4, 3) and maps.roughness.shape == (4, 4, 1)
    assert (maps.roughness == np.float32(0.9)).all()
    assert (maps.specular_rgb == np.float32(0.25)).all()
