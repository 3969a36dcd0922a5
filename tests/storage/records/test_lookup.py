"""Look-ups and facts of maps against obvious twins: loops over texels, and closed forms."""

import math

import numpy as np
import pytest

from storage.conventions import latlong_direction, latlong_uv, srgb8
from storage.records.environment import Environment
from storage.records.lookup import environment_values, texture_values
from storage.records.scene_facts import SkyFacts, sky_facts, texture_families, textured_objects
from storage.records.texture import MapSource, Texture
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.sky_maps import COLOURS, POLES, six_poles
from tests.textured_by_hand import colour_texture, number_texture, sky, textured_scene


def test_six_directions_stand_where_the_conventions_say() -> None:
    """The table of Blender: centre +X, a quarter +Y, three quarters -Y, the border -X, top +Z."""
    expected = {"+X": (0.5, 0.5), "+Y": (0.25, 0.5), "-Y": (0.75, 0.5)}
    for name, place in expected.items():
        assert latlong_uv(POLES[name]) == pytest.approx(place, abs=1e-15)
    assert latlong_uv(POLES["-X"])[0] % 1 == pytest.approx(0, abs=1e-15)
    assert latlong_uv(POLES["+Z"])[1] == 1 and latlong_uv(POLES["-Z"])[1] == 0


def test_six_coloured_poles_shine_from_their_directions() -> None:
    """Turning by 90 degrees or a mirror fails; `latlong_direction` draws the map by the table."""
    for rotation in (np.eye(3, dtype=np.float32), sky().rotation):
        environment = six_poles(rotation=rotation)
        for name, direction in POLES.items():
            found = environment_values(environment, rotation @ direction)
            assert found == pytest.approx(COLOURS[name])


def test_directions_and_places_are_inverse() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near_poles = [(1e-9, 2e-9, 1), (-3e-12, 1e-12, -1)]
    for each in (directions, np.array(near_poles)):
        back = latlong_direction(latlong_uv(each))
        assert np.abs(back - each).max() < 1e-14  # a few roundings of double precision
    relative = latlong_direction(latlong_uv(near_poles))[:, :2] / np.array(near_poles)[:, :2]
    # v itself is known to 1e-16 near 1, which is 3e-16 radians of the 2e-9 between these and +Z
    assert relative[0] == pytest.approx(1, abs=1e-6)


def _texel(texture: Texture, row: int, column: int) -> np.ndarray:
    height, width, _ = texture.texels.shape
    return texture.linear(texture.texels[row % height, column % width]).astype(np.float64)


def _slow(texture: Texture, u: float, v: float) -> np.ndarray:
    """Return the sum over all texels, each weighted by its tents in u and v."""
    height, width, channels = texture.texels.shape
    total = np.zeros(channels)
    for row in range(-height, 3 * height):
        for column in range(-width, 3 * width):
            across = max(0.0, 1 - abs((v % 1) * height - (row + 0.5)))
            along = max(0.0, 1 - abs((u % 1) * width - (column + 0.5)))
            total += across * along * _texel(texture, row, column)
    return total


@for_each("texture", [colour_texture(), number_texture()])
def test_a_texture_is_the_sum_of_its_tents(texture: Texture) -> None:
    places = [(0, 0), (0.5, 0.5), (1, 1), (-0.25, 1.25), (0.999, 0.001), (7.3, -12.8)]
    for u, v in places:
        # a few roundings of numbers below 10
        assert texture_values(texture, (u, v)) == pytest.approx(_slow(texture, u, v), abs=1e-13)


def test_row_0_is_the_bottom_and_column_0_the_left() -> None:
    texture = Texture(texels=np.array([[[0], [0.25]], [[0.5], [0.75]]], np.float32))
    corners = {(0.25, 0.25): 0, (0.75, 0.25): 1, (0.25, 0.75): 2, (0.75, 0.75): 3}
    for place, value in corners.items():
        assert texture_values(texture, place) == value / 4
        further = np.add(place, (5, -3))
        assert texture_values(texture, further) == value / 4


def test_eight_bits_are_decoded_before_they_are_mixed() -> None:
    """Halfway between black and white sRGB is 0.5, and not what the code 127 stands for."""
    texels = np.array([[[0], [255]]], np.uint8)
    for is_srgb in (True, False):
        assert texture_values(Texture(texels=texels, is_srgb=is_srgb), (0.5, 0)) == 0.5
    every = np.arange(256, dtype=np.uint8).reshape(1, 256, 1)
    linear = Texture(texels=every, is_srgb=True).linear(every)
    assert (srgb8(linear) == every).all()
    assert linear[0, 188, 0] == pytest.approx(0.502886, abs=1e-6)  # IEC 61966-2-1
    assert Texture(texels=every).linear(every)[0, 51, 0] == np.float32(0.2)


def test_a_map_goes_round_and_ends_at_the_poles() -> None:
    environment = sky(rotation=np.eye(3, dtype=np.float32))
    radiance = environment.radiance_rgb.astype(np.float64)
    height, width = radiance.shape[:2]
    border = latlong_direction((0, 0.5))
    expected = (radiance[1, 0] + radiance[1, -1]) / 2
    assert environment_values(environment, border) == pytest.approx(expected, abs=1e-12)
    for row in range(height):
        for column in range(width):
            place = (column + 0.5) / width, 1 - (row + 0.5) / height
            found = environment_values(environment, 3 * latlong_direction(place))
            # a sun of 1e6 beside it counts by the rounding of its place, a few 1e-16
            assert found == pytest.approx(radiance[row, column], abs=1e-8)
    assert environment_values(environment, (0, 0, 1)) == pytest.approx(
        (radiance[0, 2] + radiance[0, 3]) / 2, abs=1e-8
    )


def test_mean_greatest_and_constant() -> None:
    for texture in (colour_texture(), number_texture()):
        linear = texture.linear(texture.texels).astype(np.float64)
        assert texture.mean == pytest.approx(linear.mean(axis=(0, 1)), rel=1e-6)  # of float32
        assert (texture.greatest == linear.max(axis=(0, 1))).all()
        assert texture.constant is None
    assert Texture(texels=np.full((3, 2, 1), 255, np.uint8)).constant == np.ones(1)


def test_far_coordinates_lose_no_digits() -> None:
    """1023 + 1/8 is exact in float32, and means 1/8."""
    far = texture_values(colour_texture(), np.array([1023.125, -1023.875], np.float32))
    assert (far == texture_values(colour_texture(), (0.125, 0.125))).all()
    assert math.isfinite(far.sum())


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
