"""Anchors stand where something is met, and gather what a slow sum over directions gathers."""

import numpy as np
import pytest

from model.hits.anchors import anchor_pixels
from model.hits.view_inputs import Channel
from tests.model.hits.kit import FLOOR, corner, traced
from tests.pipeline.renders.closed_forms import lambert_irradiance
from tests.pipeline.renders.scene_kit import join, light, material, quad


def test_each_part_has_its_own_anchor_and_prefers_what_is_met() -> None:
    coverage = np.zeros((8, 8), np.float32)
    coverage[0, 3] = 0.25  # in the part at the top left, far from its middle
    pixels = anchor_pixels(coverage, 2)
    rows, columns = pixels // 8, pixels % 8
    assert list(zip(rows // 4, columns // 4, strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert (rows[0], columns[0]) == (0, 3)
    assert abs(rows[1] - 1.5) < 1, "where nothing tells them apart, the most central"


def test_an_anchor_for_each_pixel() -> None:
    assert np.array_equal(anchor_pixels(np.ones((4, 4), np.float32), 4), np.arange(16))


def test_light_gathered_beside_a_bright_wall_is_that_of_its_view() -> None:
    """A floor beside a white wall that a far lamp lights evenly: Lambert's formula, twice."""
    wall = np.array([[-3, 1, 0.0], [3, 1, 0], [3, 1, 6], [-3, 1, 6]])
    lamp = np.array([[-1, -40, 3.0], [1, -40, 3], [0, -40, 5]])
    parts = [quad(FLOOR, material()), quad(wall, material(diffuse=1.0)), light(lamp, 4000.0)]
    scene = join(parts, eye=(0, -1, 2), target=(0, 0, 0), fov_deg=2.0)
    inputs = traced(scene, 8, anchors_a_side=4, gather_rays=256)
    middle = wall.mean(axis=0, keepdims=True)
    radiance = lambert_irradiance(middle, np.array([0, -1.0, 0]), lamp, 4000.0) / np.pi
    seen = lambert_irradiance(np.zeros((1, 3)), np.array([0, 0, 1.0]), wall, float(radiance[0]))
    # the lamp lights the rim of the wall 2 % less; the black floor takes nothing part in it
    assert inputs.gathered.mean() == pytest.approx(float(seen[0]) / np.pi, rel=0.03)


def test_more_rays_less_noise_the_same_mean() -> None:
    few = [traced(corner(), gather_rays=8, seed=seed).gathered for seed in range(12)]
    many = [traced(corner(), gather_rays=128, seed=seed).gathered for seed in range(4)]
    error = np.std([x.mean() for x in few], ddof=1) / np.sqrt(len(few))
    assert abs(np.mean(few) - np.mean(many)) < 5 * error + 1e-3 * np.mean(many)
    assert np.std(many, axis=0).mean() < 0.6 * np.std(few, axis=0).mean()


def test_where_nothing_is_met_nothing_is_gathered() -> None:
    inputs = traced(corner(), 32)
    met = inputs.pixels.reshape(-1, inputs.pixels.shape[-1])[inputs.anchor, Channel.COVERAGE]
    assert not inputs.gathered[met[:, 0] == 0].any()
    assert inputs.gathered[met[:, 0] > 0].any()
