"""Light tracing, its parts, and beside the path tracer: alone and together the same light."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pipeline.renders import ggx, vector_tracer
from pipeline.renders.camera import PixelCamera
from pipeline.renders.device_memory import read_back
from pipeline.renders.emission_cone import EmissionCone
from pipeline.renders.film import Film
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.splats import Splats, SplatUnit, splat_unit
from pipeline.renders.vector_tracer import (
    VectorTracer,
    even_numbers,
    even_shifts,
    trace_camera_paths,
    trace_light_paths,
)
from storage.conventions import camera_rays
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import (
    Estimate,
    assert_agree,
    assert_honest,
    camera_of,
    render_blocks,
)
from tests.pipeline.renders.scene_kit import Part, box, join, light, material, quad, sphere
from tests.pipeline.renders.test_ggx import kernel_lobes, seen_at

pytestmark = pytest.mark.usefixtures("llvm")


_ALMOST_ALL = 2.0**30
"""Light paths for each camera path, of which weights leave a millionth to the other strategies."""


class CameraPathsOnly(VectorTracer):
    """The path tracer as it is without light paths."""

    _light_paths = 0.0
    _traced = staticmethod(trace_camera_paths)


class CameraPathsLeft(CameraPathsOnly):
    """What weights leave to camera paths beside light paths without number."""

    _light_paths = _ALMOST_ALL


class LightPathsOnly(VectorTracer):
    """All light but the direct one from light paths alone, with a weight of 1."""

    _light_paths = _ALMOST_ALL
    _traced = staticmethod(trace_light_paths)

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int) -> None:
        super().__init__(scene, max_depth=max_depth, rr_depth=rr_depth)
        # each of so many paths counts for so much less
        self._unit = SplatUnit(splat_unit(scene) / 2.0**32)

    def _num_light_paths(self, camera: PixelCamera, spp: int) -> int:
        return camera.resolution**2 * spp


LAMP = [[0.8, 0.3, 1.6], [1.1, 0.3, 1.6], [0.9, 0.6, 1.7]]


WIDE = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
WALL = [[-2, 1, 0], [2, 1, 0], [2, 1, 2], [-2, 1, 2]]


def _matt() -> Scene:
    parts = [quad(corners, material(diffuse=[0.7, 0.5, 0.3])) for corners in (WIDE, WALL)]
    return join([*parts, light(LAMP, 40.0)], eye=(0, -2.2, 1.2), fov_deg=60)


def _leaning() -> Scene:
    """A large light shines on a wall that a wrong shading normal turns upwards by 30 degrees."""
    wall = quad(WALL, material(specular=0.9, roughness=0.8))
    turned = np.broadcast_to([0, -np.sqrt(0.75), 0.5], wall.normals.shape)
    floor = quad(WIDE, material(diffuse=0.6))
    return _by_a_large_light([floor, dataclasses.replace(wall, normals=turned)])


def _by_a_large_light(parts: list[Part]) -> Scene:
    lamp = light([[-1, -1, 1.5], [1, -1, 1.5], [0, -1, 2.5]], 5.0, 0.5)
    return join([*parts, lamp], eye=(0, -0.2, 2), target=(0, 0.3, 0), fov_deg=40)


def _ball(roughness: float, *, lamp_diffuse: float = 0.0, closed: bool = False) -> Scene:
    """A coarse ball with smooth normals throws light on a floor that is a little glossy."""
    floor = material(diffuse=[0.6, 0.5, 0.4], specular=0.2, roughness=0.5)
    metal = material(diffuse=0.05, specular=[0.9, 0.8, 0.7], roughness=roughness)
    parts = [
        quad(WIDE, floor),
        sphere([0, 0, 0.5], 0.4, metal, rings=5),
        light(LAMP, 40.0, lamp_diffuse),
        light(np.array(LAMP) - [1.5, 0, 0.8], [1.0, 2.0, 4.0], lamp_diffuse),
    ]
    if closed:
        walls = material(diffuse=0.5, specular=0.2, roughness=0.3)
        parts.append(box([0, 0, 1], 5.0, walls, kind="shell"))
    return join(parts, eye=(0, -2.2, 1.2), target=(0, 0, 0.3), fov_deg=45)


@pytest.mark.slow("statistics")
@pytest.mark.parametrize(
    ("scene", "max_depth"),
    [(_matt(), 10), (_leaning(), 3), (_ball(0.6), 3),
     (_ball(0.6, lamp_diffuse=1.0, closed=True), 10)],
    ids=["matt", "leaning", "glossy", "closed, white emitters"],
)  # fmt: skip
def test_light_paths_alone_carry_all_indirect_light(scene: Scene, max_depth: int) -> None:
    """The two integrators share no estimate of it: one starts at the camera, one at the lights."""
    indirect = _less(
        _means(CameraPathsOnly, scene, max_depth=max_depth),
        _means(CameraPathsOnly, scene, max_depth=2, first_seed=100),
    )
    landed = _means(LightPathsOnly, scene, max_depth=max_depth, first_seed=200)
    # Where a smooth normal leans away from the light (measured: 0.2 % of the light of the coarse
    # ball), a path can be drawn from the camera only; light paths leave that out.
    assert_agree(landed, indirect, slack=5e-3)
    assert indirect.mean.min() > 10 * indirect.error.max()


@pytest.mark.parametrize(
    ("scene", "max_depth"),
    [(_ball(0.3), 10),
     pytest.param(_ball(0.3, lamp_diffuse=1.0), 2, marks=pytest.mark.slow("statistics")),
     (_ball(0.3, lamp_diffuse=0.5, closed=True), 3)],
    ids=["glossy", "white emitters", "closed"],
)  # fmt: skip
def test_together_they_show_what_the_path_tracer_shows(scene: Scene, max_depth: int) -> None:
    """Weights sum to 1 for every path, whatever it is made of."""
    alone = render_blocks(scene, tracer=CameraPathsOnly(scene, max_depth=max_depth, rr_depth=2))
    tracer = load_tracer(scene, max_depth=max_depth, rr_depth=2)
    together = render_blocks(scene, first_seed=500, tracer=tracer)
    assert_agree(together, alone)
    assert_honest(alone, together, bias=0.5)  # caustics have a tail


def test_any_number_of_light_paths_gives_the_same_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """However the weights are shared out."""
    scene = _leaning()
    alone = _means(CameraPathsOnly, scene, passes=12)
    for light_paths in (1e-3, 4.0):
        monkeypatch.setattr(vector_tracer, "LIGHT_PATHS", light_paths)
        assert_agree(_means(VectorTracer, scene, first_seed=300, passes=12), alone)


def test_beside_light_paths_without_number_only_direct_light_is_left() -> None:
    """Of a large light, so that as much would be hit as picked."""
    row = material(diffuse=0.3, specular=0.5, roughness=0.4)
    scene = _by_a_large_light([quad(WIDE, row), quad(WALL, row)])
    left = _means(CameraPathsLeft, scene, first_seed=100, passes=12)
    # Weights leave a millionth, but more where a vertex is close to the next one, in the corner.
    assert_agree(left, _means(CameraPathsOnly, scene, max_depth=2, passes=12), slack=1e-3)


def test_light_paths_do_not_show_emitters_either() -> None:
    """A white panel above a lit floor fills the picture, and stays hidden from the camera."""
    floor = quad(WIDE, material(diffuse=0.6))
    panel = light([[-2.0, 1.0, 0.5], [2.0, 1.0, 0.5], [0.0, 1.0, 4.0]], 1.0, 1.0)
    parts = [floor, panel, light(LAMP, 40.0)]
    scene = join(parts, eye=(0, -2, 1), target=(0, 1, 1.5), fov_deg=20)
    tracer = LightPathsOnly(scene, max_depth=10, rr_depth=9)
    np.testing.assert_array_equal(tracer.radiance(camera_of(scene, 32), seed=1, spp=64), 0)


def test_a_caustic_has_a_fraction_of_the_noise() -> None:
    """What a mirror beside the picture throws on the floor; measured: 0.12 of the variance."""
    floor = quad(WIDE, material(diffuse=0.5))
    mirror = material(specular=0.9, roughness=0.1)
    wall = quad([[-1.5, -1, 0], [-1.5, 1, 0], [-1.5, 1, 1], [-1.5, -1, 1]], mirror)
    lamp = light([[1.2, -0.1, 1.4], [1.2, 0.1, 1.4], [1.2, 0, 1.6]], 40.0)
    scene = join([floor, wall, lamp], eye=(0, -0.2, 2), target=(-0.2, 0, 0), fov_deg=40)
    camera_paths = CameraPathsOnly(scene, max_depth=3, rr_depth=2)
    alone = render_blocks(scene, tracer=camera_paths, passes=10)
    together = render_blocks(scene, max_depth=3, rr_depth=2, passes=10)
    assert np.square(together.error).mean() < 0.25 * np.square(alone.error).mean()
    assert_agree(together, alone)
    direct = render_blocks(scene, max_depth=2, rr_depth=2, passes=4)
    assert (together.mean - direct.mean).max() > 0.2 * direct.mean.max()


def _means(
    kind: type[VectorTracer],
    scene: Scene,
    *,
    max_depth: int = 10,
    first_seed: int = 0,
    passes: int = 32,
) -> Estimate:
    """Return the mean of the picture from some passes."""
    tracer = kind(scene, max_depth=max_depth, rr_depth=2)
    return render_blocks(scene, block=32, passes=passes, first_seed=first_seed, tracer=tracer)


def _less(a: Estimate, b: Estimate) -> Estimate:
    return Estimate(mean=a.mean - b.mean, error=np.hypot(a.error, b.error))


_LAMP = [[-0.1, -0.1, 3], [0, 0.1, 3], [0.1, -0.1, 3]]
_FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]


def _scene(radiance: float = 5.0) -> Scene:
    return join([quad(_FLOOR, material(diffuse=0.5)), light(_LAMP, radiance)], eye=(0, -2, 1))


def test_splats_add_up_in_any_order() -> None:
    """To the nearest unit each, with the same bits."""
    rng = np.random.default_rng(1)
    values = rng.exponential(size=(3, 5000)).astype(np.float32) * 10.0 ** rng.uniform(-6, 3, 5000)
    pixels = rng.integers(0, 16, 5000).astype(np.uint32)
    pictures = []
    for order in (np.arange(5000), rng.permutation(5000)):
        splats = Splats(4, SplatUnit(splat_unit(_scene())))
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
    unit = splat_unit(_scene())
    splats = Splats(1, SplatUnit(unit))
    for units in (0.25, 0.75):
        colour = mi.Color3f(*(np.full(1000, units * unit, np.float32) for _ in range(3)))
        splats.add(colour, mi.UInt32(np.zeros(1000, np.uint32)), mi.Bool(True))
    counted = read_back(splats.picture()).ravel() / unit
    np.testing.assert_array_equal(counted, [1000.0] * 3)


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e9])
def test_a_splat_that_no_sum_can_hold_shows(value: float) -> None:
    for channel in range(3):
        colour = [0.25, 0.25, 0.25]
        colour[channel] = value
        splats = Splats(2, SplatUnit(splat_unit(_scene())))
        splats.add(mi.Color3f(*colour), mi.UInt32([1]), mi.Bool(True))
        splats.add(mi.Color3f(value), mi.UInt32([2]), mi.Bool(False))
        splats.add(mi.Color3f(0.5), mi.UInt32([0]), mi.Bool(True))
        broken = np.isnan(read_back(splats.picture())).reshape(2, 2, 3).all(axis=-1)
        np.testing.assert_array_equal(broken, [[False, True], [False, False]])


def test_a_unit_is_a_power_of_two_that_goes_with_the_light() -> None:
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
    cone = EmissionCone(_scene())
    count, normal = 1 << 16, dr.normalize(mi.Vector3f(0.3, 0.5, 1.0))
    u = even_numbers(count, even_shifts(7))
    drawn = cone.sample(mi.Point3f(*position), normal, mi.Point2f(u[2], u[3]))
    pdf = np.array(cone.pdf(mi.Point3f(*position), normal, drawn), np.float64)
    directions = np.array(drawn).T.astype(np.float64)
    inside = pdf > 0
    assert inside.mean() > 0.9999  # all but roundings at the rim
    directions, pdf = directions[inside], pdf[inside]
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)  # float32
    distance, radius = np.linalg.norm(position), 1.001 * np.sqrt(2)
    axis = -np.array(position) / distance
    if distance > radius:
        lowest = np.sqrt(1 - (radius / distance) ** 2)
        solid_angle, first_moment = 2 * np.pi * (1 - lowest), np.pi * (1 - lowest**2)
        assert (directions @ axis > lowest - 1e-6).all()
        np.testing.assert_allclose(pdf, 1 / solid_angle, rtol=1e-3)  # 1 - cos in float32
    else:
        cosine = np.abs(directions @ np.array(normal).ravel())
        np.testing.assert_allclose(pdf, cosine / (2 * np.pi), atol=1e-6)
        first_moment = 0.0
    # Standard errors are some 1 / sqrt(count) = 0.4 %; even points do better.
    assert abs((directions @ axis / pdf).mean() - first_moment) < 5e-3 * max(first_moment, 4)
    assert np.array(cone.pdf(mi.Point3f(0, 0, 9), normal, mi.Vector3f(0, 0, 1))).item() == 0


def test_light_starts_are_even_and_their_shift_goes_with_the_seed() -> None:
    count = 4096
    first, second = (np.array(even_numbers(count, even_shifts(seed))) for seed in (1, 2))
    assert first.shape == (4, count) and 0 <= first.min() and first.max() < 1
    assert (np.abs(first - second).max(axis=1) > 1e-3).all()
    for a in range(4):
        for b in range(a):
            cells = np.histogram2d(first[a], first[b], bins=8, range=[[0, 1], [0, 1]])[0]
            # Independent numbers are off by sqrt(64) = 8 on average and by 25 somewhere.
            assert np.abs(cells - 64).max() < 16


def test_a_point_shows_in_the_pixel_whose_ray_meets_it() -> None:
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
    film = Film(camera_of(_scene(), 16))
    for x, y in ((8.0, 8.0), (0.5, 15.0), (3.0, 6.0)):
        step = 0.1
        columns = mi.Float([x, x + step, x - step, x, x])
        rows = mi.Float([y, y, y, y + step, y - step])
        ray = np.array(film.rays(columns, rows).d, np.float64)
        along_x, along_y = ray[:, 1] - ray[:, 2], ray[:, 3] - ray[:, 4]
        solid_angle = np.linalg.norm(np.cross(along_x, along_y)) / (2 * step) ** 2
        pdf = np.array(film.pdf(mi.Vector3f(*ray[:, 0].tolist()))).item()
        # Rays are float32: 1e-7 of a difference of 0.01.
        np.testing.assert_allclose(pdf * solid_angle, 1, rtol=1e-3)


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_the_way_back_has_the_density_that_a_path_from_there_draws(roughness: float) -> None:
    """On either side of a triangle that leans against the shading normal."""
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
    expected = ggx.evaluate_bsdf(seen_at(lobes, there), there, back, normal)[1]
    found = ggx.reverse_pdf(seen_at(lobes, wi), wi, wo, geometric)
    useful = np.array(ggx.evaluate_bsdf(seen_at(lobes, wi), wi, wo, geometric)[1]) > 0
    sides = np.array(turn)[useful]
    assert (sides > 0).sum() > 100 and (sides < 0).sum() > 100
    # The same formula in another order, in float32.
    np.testing.assert_allclose(np.array(found)[useful], np.array(expected)[useful], rtol=1e-4)
