"""Parts of light tracing: sums of whole numbers, directions into the scene, pixels of points."""

import numpy as np
import pytest

from pipeline.renders import ggx
from storage.conventions import camera_rays
from storage.records.scene import Scene
from tests.pipeline.renders.kernel_lobes import kernel_lobes, seen_at
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import join, light, material, quad

pytestmark = pytest.mark.usefixtures("llvm")

_LAMP = [[-0.1, -0.1, 3], [0, 0.1, 3], [0.1, -0.1, 3]]
_FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]


def _scene(radiance: float = 5.0) -> Scene:
    return join([quad(_FLOOR, material(diffuse=0.5)), light(_LAMP, radiance)], eye=(0, -2, 1))


def test_splats_add_up_in_any_order() -> None:
    """To the nearest unit each, with the same bits."""
    import mitsuba as mi

    from pipeline.renders.device_memory import read_back
    from pipeline.renders.splats import Splats, splat_unit

    rng = np.random.default_rng(1)
    values = rng.exponential(size=(3, 5000)).astype(np.float32) * 10.0 ** rng.uniform(-6, 3, 5000)
    pixels = rng.integers(0, 16, 5000).astype(np.uint32)
    pictures = []
    for order in (np.arange(5000), rng.permutation(5000)):
        splats = Splats(4, splat_unit(_scene()))
        colour = mi.Color3f(*(channel[order].astype(np.float32) for channel in values))
        splats.add(colour, mi.UInt32(pixels[order]), mi.Bool(True))
        pictures.append(read_back(splats.picture()))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    expected = np.zeros((16, 3))
    np.add.at(expected, pixels, values.T)
    # Float32 values are off by a half of 2^-24 of themselves, units by 5 / 2^33 for each splat.
    np.testing.assert_allclose(pictures[0].reshape(16, 3), expected, rtol=1e-6, atol=1e-5)


def test_a_splat_counts_to_the_nearest_unit() -> None:
    """Cut off instead, dim light would be lost: 0.75 of a unit would be none, a thousand times."""
    import mitsuba as mi

    from pipeline.renders.device_memory import read_back
    from pipeline.renders.splats import Splats, splat_unit

    unit = splat_unit(_scene())
    splats = Splats(1, unit)
    for units in (0.25, 0.75):
        colour = mi.Color3f(*(np.full(1000, units * unit, np.float32) for _ in range(3)))
        splats.add(colour, mi.UInt32(np.zeros(1000, np.uint32)), mi.Bool(True))
    counted = read_back(splats.picture()).ravel() / unit
    np.testing.assert_array_equal(counted, [1000.0] * 3)


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e9])
def test_a_splat_that_no_sum_can_hold_shows(value: float) -> None:
    import mitsuba as mi

    from pipeline.renders.device_memory import read_back
    from pipeline.renders.splats import Splats, splat_unit

    for channel in range(3):
        colour = [0.25, 0.25, 0.25]
        colour[channel] = value
        splats = Splats(2, splat_unit(_scene()))
        splats.add(mi.Color3f(*colour), mi.UInt32([1]), mi.Bool(True))
        splats.add(mi.Color3f(value), mi.UInt32([2]), mi.Bool(False))
        splats.add(mi.Color3f(0.5), mi.UInt32([0]), mi.Bool(True))
        broken = np.isnan(read_back(splats.picture())).reshape(2, 2, 3).all(axis=-1)
        np.testing.assert_array_equal(broken, [[False, True], [False, False]])


def test_a_unit_is_a_power_of_two_that_goes_with_the_light() -> None:
    from pipeline.renders.splats import splat_unit

    for radiance in (1e-30, 1e-3, 1.0, 4095.0, 1e12):
        unit = splat_unit(_scene(radiance))
        assert np.frexp(unit)[0] == 0.5
        if radiance > 1e-27:  # dimmer ones are coarse: nothing that half floats show
            assert 2**33 <= np.float32(radiance) / unit < 2**34
            assert splat_unit(_scene(2 * radiance)) == 2 * unit
        assert np.isfinite(np.float32(1 / unit))


@pytest.mark.parametrize("position", [[0.0, 0.0, 3.0], [40.0, -10.0, 5.0], [0.1, 0.2, 0.3]])
def test_directions_into_the_scene_have_the_density_that_is_claimed(position: list[float]) -> None:
    """The mean of g / density is the integral of g over what is drawn, for any g."""
    import drjit as dr
    import mitsuba as mi

    from pipeline.renders.emission_cone import EmissionCone
    from pipeline.renders.vector_tracer import even_numbers

    cone = EmissionCone(_scene())
    count, normal = 1 << 16, dr.normalize(mi.Vector3f(0.3, 0.5, 1.0))
    u = even_numbers(count, 7)
    drawn = cone.sample(mi.Point3f(*position), normal, mi.Point2f(u[2], u[3]))
    density = np.array(cone.density(mi.Point3f(*position), normal, drawn), np.float64)
    directions = np.array(drawn).T.astype(np.float64)
    inside = density > 0
    assert inside.mean() > 0.9999  # all but roundings at the rim
    directions, density = directions[inside], density[inside]
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)  # float32
    distance, radius = np.linalg.norm(position), 1.001 * np.sqrt(2)
    axis = -np.array(position) / distance
    if distance > radius:
        lowest = np.sqrt(1 - (radius / distance) ** 2)
        solid_angle, first_moment = 2 * np.pi * (1 - lowest), np.pi * (1 - lowest**2)
        assert (directions @ axis > lowest - 1e-6).all()
        np.testing.assert_allclose(density, 1 / solid_angle, rtol=1e-3)  # 1 - cos in float32
    else:
        cosine = np.abs(directions @ np.array(normal).ravel())
        np.testing.assert_allclose(density, cosine / (2 * np.pi), atol=1e-6)
        first_moment = 0.0
    # Standard errors are some 1 / sqrt(count) = 0.4 %; even points do better.
    assert abs((directions @ axis / density).mean() - first_moment) < 5e-3 * max(first_moment, 4)
    assert np.array(cone.density(mi.Point3f(0, 0, 9), normal, mi.Vector3f(0, 0, 1))).item() == 0


def test_light_starts_are_even_and_their_shift_goes_with_the_seed() -> None:
    from pipeline.renders.vector_tracer import even_numbers

    count = 4096
    first, second = (np.array(even_numbers(count, seed)) for seed in (1, 2))
    assert first.shape == (4, count) and 0 <= first.min() and first.max() < 1
    assert (np.abs(first - second).max(axis=1) > 1e-3).all()
    for a in range(4):
        for b in range(a):
            cells = np.histogram2d(first[a], first[b], bins=8, range=[[0, 1], [0, 1]])[0]
            # Independent numbers are off by sqrt(64) = 8 on average and by 25 somewhere.
            assert np.abs(cells - 64).max() < 16


def test_a_point_shows_in_the_pixel_whose_ray_meets_it() -> None:
    import mitsuba as mi

    from pipeline.renders.film import Film

    scene, resolution = _scene(), 24
    film = Film(camera_of(scene, resolution))
    origin, directions = camera_rays(scene.c2w[0], float(scene.fov_deg[0]), resolution)
    for reach in (0.1, 3.0):
        points = (origin + reach * directions).reshape(-1, 3).astype(np.float32)
        pixel, inside = film.pixel(mi.Point3f(points.T))
        assert np.array(inside).all()
        np.testing.assert_array_equal(np.array(pixel), np.arange(resolution**2))
        _, behind = film.pixel(mi.Point3f((origin - reach * directions).reshape(-1, 3).T))
        assert not np.array(behind).any()
    wider = camera_rays(scene.c2w[0], float(scene.fov_deg[0]) + 20, resolution)[1]
    rim = np.ones((resolution, resolution), bool)
    rim[4:-4, 4:-4] = False
    _, inside = film.pixel(mi.Point3f((origin + wider[rim]).T))
    assert not np.array(inside).any()


def test_pixels_per_steradian_are_those_of_the_rays() -> None:
    """By finite differences of a tenth of a pixel."""
    import mitsuba as mi

    from pipeline.renders.film import Film

    film = Film(camera_of(_scene(), 16))
    for x, y in ((8.0, 8.0), (0.5, 15.0), (3.0, 6.0)):
        step = 0.1
        columns = mi.Float([x, x + step, x - step, x, x])
        rows = mi.Float([y, y, y, y + step, y - step])
        ray = np.array(film.rays(columns, rows).d, np.float64)
        along_x, along_y = ray[:, 1] - ray[:, 2], ray[:, 3] - ray[:, 4]
        solid_angle = np.linalg.norm(np.cross(along_x, along_y)) / (2 * step) ** 2
        density = np.array(film.density(mi.Vector3f(*ray[:, 0].tolist()))).item()
        # Rays are float32: 1e-7 of a difference of 0.01.
        np.testing.assert_allclose(density * solid_angle, 1, rtol=1e-3)


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_the_way_back_has_the_density_that_a_path_from_there_draws(roughness: float) -> None:
    """On either side of a triangle that leans against the shading normal."""
    import drjit as dr
    import mitsuba as mi

    lobes = kernel_lobes(diffuse=0.3, specular=0.5, roughness=roughness)
    rng = np.random.default_rng(3)
    wi, wo, geometric = (
        dr.normalize(mi.Vector3f(rng.normal(size=(3, 4000)) + up * np.array([[0], [0], [1]])))
        for up in (0.5, 1.5, 1.0)
    )
    geometric *= dr.mulsign(mi.Float(1), dr.dot(geometric, wi))  # faces the viewer
    turn = dr.mulsign(mi.Float(1), dr.dot(geometric, wo))
    mirror = mi.Vector3f(1, 1, turn)
    there, back = wo * mirror, wi * mirror
    normal = geometric * mirror * turn
    expected = ggx.evaluate(seen_at(lobes, there), there, back, normal)[1]
    found = ggx.reverse_density(seen_at(lobes, wi), wi, wo, geometric)
    useful = np.array(ggx.evaluate(seen_at(lobes, wi), wi, wo, geometric)[1]) > 0
    sides = np.array(turn)[useful]
    assert (sides > 0).sum() > 100 and (sides < 0).sum() > 100
    # The same formula in another order, in float32.
    np.testing.assert_allclose(np.array(found)[useful], np.array(expected)[useful], rtol=1e-4)
