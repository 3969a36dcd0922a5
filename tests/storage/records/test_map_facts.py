"""Facts of maps against closed forms: a constant sky, one bright texel, and half a sphere."""

import numpy as np
import pytest

from storage.records.environment import Environment
from storage.records.map_facts import SkyFacts, sky_facts, texture_families, textured_objects
from storage.records.texture import MapSource, Texture
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.textured_by_hand import colour_texture, sky, textured_scene

HEIGHT = 90


def facts(radiance: np.ndarray) -> SkyFacts:
    return sky_facts(Environment(radiance_rgb=radiance.astype(np.float32)))


def test_a_constant_sky_has_half_of_its_light_in_half_of_the_sphere() -> None:
    found = facts(np.full((HEIGHT, 2 * HEIGHT, 3), 0.7))
    assert found.mean_radiance == pytest.approx(0.7, rel=1e-6)
    assert found.peak == pytest.approx(1, rel=1e-6)
    # half of the sphere is the cone of 180 degrees across; 1e-4 is the rounding of float32 radiance
    assert found.half_light_deg == pytest.approx(180, abs=1e-3)


def test_half_of_a_sphere_and_one_texel() -> None:
    """A lit upper half has half of its light in 2 pi / 2 steradians: 120 degrees across."""
    half = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    half[: HEIGHT // 2] = [3, 2, 1]
    found = facts(half)
    assert (found.mean_radiance, found.peak) == (pytest.approx(1), pytest.approx(2))
    assert found.half_light_deg == pytest.approx(120, abs=1e-3)
    sun = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    sun[HEIGHT // 2, 17] = 1e6
    texel = np.sin(np.pi / HEIGHT) * np.pi / HEIGHT  # steradians, from the equator down
    found = facts(sun)
    assert found.mean_radiance == pytest.approx(1e6 * texel / (4 * np.pi), rel=1e-6)
    across = np.degrees(2 * np.arccos(1 - texel / 2 / (2 * np.pi)))
    assert found.half_light_deg == pytest.approx(across, rel=1e-6)
    assert facts(np.zeros((2, 4, 3))) == SkyFacts(mean_radiance=0, peak=0, half_light_deg=0)


def test_what_textures_are_called_and_where_they_are() -> None:
    named = Texture(texels=colour_texture().texels, source=MapSource(name="fine planks diffuse"))
    other = Texture(texels=np.zeros((1, 2, 1), np.uint8), source=MapSource(name="worn by hand"))
    scene = textured_scene(0, named, other)
    assert texture_families(scene) == {"fine planks", "worn by hand"}
    assert textured_objects(scene) == set(
        np.unique(scene.object_index[scene.material_index == FLOOR])
    )
    plain = tiny_scene(environment=sky())
    assert texture_families(plain) == textured_objects(plain) == set()
