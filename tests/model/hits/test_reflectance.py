"""The specular lobe in numpy: its samples and its density are of one lobe, and it loses nothing."""

import numpy as np
import pytest

from model.hits.lit_scene import LitScene, Points
from model.hits.reflectance import drawn, gloss_at, lobe
from model.hits.vectors import dot, unit
from storage.records.multiscatter import directional_albedo
from tests.for_each import for_each

COUNT = 20_000


def _plate(roughness: float, specular: float = 1.0) -> LitScene:
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
    materials = np.zeros((1, 10), np.float32)
    materials[0, 3:6], materials[0, 6] = specular, roughness
    return LitScene(corners, np.tile(np.array([0, 0, 1], np.float32), (1, 3, 1)), materials)


def _points(scene: LitScene, toward: np.ndarray) -> Points:
    count = toward.shape[1]
    uv = np.full((2, count), 0.25, np.float32)
    return scene.points(np.zeros(count, np.intp), uv, -toward.astype(np.float32))


def _toward(cosine: float, count: int = COUNT) -> np.ndarray:
    sine = np.sqrt(1 - cosine**2)
    return np.tile(np.array([[sine], [0.0], [cosine]], np.float32), (1, count))


@for_each("roughness", [0.1, 0.3, 0.6, 1.0])
@for_each("cosine", [0.95, 0.4, 0.1])
def test_a_white_lobe_returns_all_light(roughness: float, cosine: float) -> None:
    """Single scattering by drawn directions, and the scale for the rest: together 1."""
    scene = _plate(roughness)
    points = _points(scene, _toward(cosine))
    gloss = gloss_at(scene, points)
    u = np.random.default_rng(0).random((2, COUNT), np.float32)
    _, weight = drawn(gloss, points, u)
    alpha = roughness**2
    stretch = np.sqrt(cosine**2 + alpha**2 * (1 - cosine**2))
    single = directional_albedo(cosine / stretch, alpha, "correlated")
    # standard error of weights between 0 and 1, five times; then the table's 0.25 % between entries
    assert weight.mean() == pytest.approx(float(single), abs=5 * 0.5 / np.sqrt(COUNT))
    assert float(single) * gloss.colour[0, 0] == pytest.approx(1.0, abs=4e-3)


@for_each("roughness", [0.15, 0.4, 0.9])
def test_a_sample_weighs_its_value_over_its_density(roughness: float) -> None:
    scene = _plate(roughness)
    points = _points(scene, _toward(0.6, 500))
    gloss = gloss_at(scene, points)
    u = np.random.default_rng(1).random((2, 500), np.float32)
    direction, weight = drawn(gloss, points, u)
    value, density = lobe(gloss, points, direction, dot(direction, points.normal))
    goes = weight > 0
    assert goes.mean() > 0.7
    # half vectors in single precision, of a lobe as narrow as 0.02
    np.testing.assert_allclose(value[goes] / density[goes], weight[goes], rtol=0.02)


@for_each("roughness", [0.3, 0.8])
def test_the_density_integrates_to_what_is_drawn_above(roughness: float) -> None:
    """Over the hemisphere, by even directions: all that is drawn and not lost below."""
    rng = np.random.default_rng(2)
    scene = _plate(roughness)
    height, turn = rng.random(COUNT), 2 * np.pi * rng.random(COUNT)
    radius = np.sqrt(1 - height**2)
    even = np.stack([radius * np.cos(turn), radius * np.sin(turn), height]).astype(np.float32)
    points = _points(scene, _toward(0.7))
    gloss = gloss_at(scene, points)
    _, density = lobe(gloss, points, even, even[2])
    _, weight = drawn(gloss, points, rng.random((2, COUNT)).astype(np.float32))
    spread = 2 * np.pi * density.std() / np.sqrt(COUNT)
    assert 2 * np.pi * density.mean() == pytest.approx((weight > 0).mean(), abs=5 * spread + 0.01)


def test_the_lobe_is_symmetric_but_for_its_scale() -> None:
    """D G2 / 4 / cosines: exchanging viewer and light changes nothing."""
    scene = _plate(0.5)
    rng = np.random.default_rng(3)
    a, b = (unit(rng.normal(size=(3, 300)).astype(np.float32)) for _ in range(2))
    a[2], b[2] = np.abs(a[2]) + 0.05, np.abs(b[2]) + 0.05
    a, b = unit(a), unit(b)
    there = lobe(gloss_at(scene, _points(scene, a)), _points(scene, a), b, b[2])[0] / b[2]
    back = lobe(gloss_at(scene, _points(scene, b)), _points(scene, b), a, a[2])[0] / a[2]
    np.testing.assert_allclose(there, back, rtol=1e-3)


def test_from_behind_and_below_nothing_is_reflected() -> None:
    scene = _plate(0.3)
    points = _points(scene, _toward(0.5, 2))
    below = np.array([[0.6, 0.0], [0.0, 0.8], [-0.8, -0.6]], np.float32)
    value, _ = lobe(gloss_at(scene, points), points, below, below[2])
    assert not value.any()
