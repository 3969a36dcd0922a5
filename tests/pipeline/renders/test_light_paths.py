"""Light tracing and path guiding, beside the path tracer: the same light with and without."""

import dataclasses
import functools
from typing import Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import guide_table, vector_tracer
from pipeline.renders.device_memory import read_back
from pipeline.renders.film import Film, Splats, SplatUnit
from pipeline.renders.guide_table import (
    BINS,
    ENTRIES,
    SIDE,
    Guidance,
    GuideCells,
    GuideTable,
    apportion_entries,
    bin_of,
    learn,
)
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.tracer import PixelCamera
from pipeline.renders.vector_tracer import (
    VectorTracer,
    even_numbers,
    even_shifts,
)
from storage.conventions import camera_rays
from storage.metrics import psnr_log_db
from storage.records.lights import sum_of_lights
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_honest,
    assert_same_light,
    camera_of,
    render_blocks,
    render_passes,
    render_view,
    view_settings,
)
from tests.pipeline.renders.scene_kit import (
    GUIDED_FLOOR,
    GUIDED_LAMP,
    GUIDED_WALL,
    Part,
    box,
    join,
    lamp_over_floor,
    light,
    lit_by_a_mirror,
    material,
    mirrors,
    quad,
    sphere,
    textured_floor,
)
from tests.pipeline.renders.test_renderer import lit_scene
from tests.sky_maps import smooth

pytestmark = pytest.mark.usefixtures("llvm")


class CameraPathsOnly(VectorTracer):
    """The path tracer as it is without light paths."""

    _light_paths = 0.0

    def _light(self, camera: PixelCamera, seed: int | None, spp: int) -> Any:
        return [dr.zeros(mi.Color3f, camera.resolution**2)]


class CameraPathsLeft(CameraPathsOnly):
    """What weights leave to camera paths beside light paths without number: a millionth."""

    _light_paths = 2.0**30


def _tracer(
    scene: Scene, kind: type[VectorTracer] = VectorTracer, max_depth: int = 10
) -> VectorTracer:
    return kind(scene, max_depth=max_depth, rr_depth=2)


mean_picture = functools.partial(render_blocks, block=32, passes=12)
"""The mean of a picture."""

LAMP = [[0.8, 0.3, 1.6], [1.1, 0.3, 1.6], [0.9, 0.6, 1.7]]
WIDE = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
WALL = [[-2, 1, 0], [2, 1, 0], [2, 1, 2], [-2, 1, 2]]


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


@pytest.mark.parametrize(
    ("scene", "max_depth"),
    [(_ball(0.3), 10), (_ball(0.3, lamp_diffuse=0.5, closed=True), 3)],
    ids=["glossy", "closed"],
)
def test_together_they_show_what_the_path_tracer_shows(scene: Scene, max_depth: int) -> None:
    """Weights sum to 1 for every path, whatever it is made of."""
    alone = render_blocks(scene, tracer=_tracer(scene, CameraPathsOnly, max_depth))
    together = render_blocks(scene, first_seed=500, max_depth=max_depth, rr_depth=2)
    assert_agree(together, alone)
    assert_honest(alone, together, bias=0.5)  # caustics have a tail


def test_any_number_of_light_paths_gives_the_same_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """However the weights are shared out.

    A large light shines on a wall that a wrong shading normal turns upwards by 30 degrees.
    """
    wall = quad(WALL, material(specular=0.9, roughness=0.8))
    turned = np.broadcast_to([0, -np.sqrt(0.75), 0.5], wall.normals.shape)
    leaning = dataclasses.replace(wall, normals=turned)
    scene = _by_a_large_light([quad(WIDE, material(diffuse=0.6)), leaning])
    alone = mean_picture(scene, tracer=_tracer(scene, CameraPathsOnly))
    for light_paths in (1e-3, 4.0):
        monkeypatch.setattr(vector_tracer, "LIGHT_PATHS", light_paths)
        monkeypatch.setattr(VectorTracer, "_light_paths", light_paths)
        assert_agree(mean_picture(scene, first_seed=300, tracer=_tracer(scene)), alone)


def test_beside_light_paths_without_number_only_direct_light_is_left() -> None:
    """Of a large light, so that as much would be hit as picked."""
    row = material(diffuse=0.3, specular=0.5, roughness=0.4)
    scene = _by_a_large_light([quad(WIDE, row), quad(WALL, row)])
    left = mean_picture(scene, first_seed=100, tracer=_tracer(scene, CameraPathsLeft))
    direct = mean_picture(scene, tracer=_tracer(scene, CameraPathsOnly, max_depth=2))
    # Weights leave a millionth, but more where a vertex is close to the next one, in the corner.
    assert_agree(left, direct, slack=1e-3)


def test_a_caustic_has_a_fraction_of_the_noise() -> None:
    """What a mirror beside the picture throws on the floor; measured: 0.12 of the variance."""
    floor = quad(WIDE, material(diffuse=0.5))
    mirror = material(specular=0.9, roughness=0.1)
    wall = quad([[-1.5, -1, 0], [-1.5, 1, 0], [-1.5, 1, 1], [-1.5, -1, 1]], mirror)
    lamp = light([[1.2, -0.1, 1.4], [1.2, 0.1, 1.4], [1.2, 0, 1.6]], 40.0)
    scene = join([floor, wall, lamp], eye=(0, -0.2, 2), target=(-0.2, 0, 0), fov_deg=40)
    alone = render_blocks(scene, tracer=_tracer(scene, CameraPathsOnly, 3), passes=10)
    together = render_blocks(scene, max_depth=3, rr_depth=2, passes=10)
    assert np.square(together.error).mean() < 0.25 * np.square(alone.error).mean()
    assert_agree(together, alone)
    direct = render_blocks(scene, max_depth=2, rr_depth=2, passes=4)
    assert (together.mean - direct.mean).max() > 0.2 * direct.mean.max()


_SEEDS = ((11, 5), (12, 6), (13, 7))
"""Of the camera paths and of the light paths of three passes."""

SHARED = view_settings(64, light_paths="scene")


def _orbit() -> tuple[Scene, list[PixelCamera]]:
    """A scene with three cameras around it."""
    scene = _ball(0.3)
    turns = [np.eye(4) for _ in range(3)]
    for turn, angle in zip(turns, (0, 0.4, 2.0), strict=True):
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    poses = np.stack([turn @ scene.c2w[0] for turn in turns]).astype(np.float32)
    scene = dataclasses.replace(scene, c2w=poses, fov_deg=np.repeat(scene.fov_deg, 3))
    return scene, [camera_of(scene, 32, view) for view in range(3)]


@pytest.mark.parametrize("lobes", [False, True])
def test_joined_to_all_cameras_at_once_light_paths_show_what_they_show_alone(lobes: bool) -> None:
    """To the last bit: which views wait, and which have been rejected, decides nothing."""
    scene, cameras = _orbit()

    def seen(views: list[int], known: int) -> dict[int, NDArray]:
        tracer = _tracer(scene).split_lights(bounces=lobes, lobes=lobes)
        tracer = tracer.for_views(cameras[:known])
        pictures = {}
        for view in views:
            total = tracer.pass_sum(cameras[view])
            for seed, light_seed in _SEEDS:
                total.add(seed=seed, spp=16, light_seed=light_seed)
            pictures[view] = np.stack(total.read()[:-3])
        return pictures

    alone = seen([0, 1, 2], 0)
    for views, known in (([0, 1, 2], 3), ([2, 0], 3), ([0, 2, 1], 2)):
        for view, picture in seen(views, known).items():
            np.testing.assert_array_equal(picture, alone[view])


def test_light_paths_of_another_seed_are_those_of_a_pass_of_that_seed() -> None:
    scene, (camera, *_) = _orbit()
    tracer = _tracer(scene)
    same, other, usual = (tracer.pass_sum(camera) for _ in range(3))
    same.add(seed=3, spp=16, light_seed=3)
    other.add(seed=3, spp=16, light_seed=4)
    usual.add(seed=3, spp=16)
    np.testing.assert_array_equal(same.read()[0], usual.read()[0])
    assert (other.read()[0] != usual.read()[0]).any()


def test_views_of_a_scene_trace_their_light_paths_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, _ = _orbit()
    joined = list[int]()
    landed = vector_tracer._land

    def counted(inputs: Any, *arguments: Any) -> Any:
        found = landed(inputs, *arguments)
        joined.append(len(found))
        return found

    monkeypatch.setattr(vector_tracer, "_land", counted)

    def views(light_seed: int | None, order: tuple[int, ...]) -> list[NDArray]:
        joined.clear()
        renderer = SceneRenderer(scene, SHARED, light_seed=light_seed)
        poses = ((scene.c2w[view], float(scene.fov_deg[view]), view) for view in order)
        return [renderer.render_view(*pose).radiance_rgb for pose in poses]

    together = views(5, (0, 1, 2))
    passes = 4  # two of 16 samples for each half
    assert joined == [3] * passes
    np.testing.assert_array_equal(views(5, (2,)), together[2:])
    assert (np.array(views(6, (0,))) != together[0]).any()
    views(None, (0, 1))
    assert not joined, "each view has its own"


def test_lamps_apart_share_the_light_paths_of_a_scene() -> None:
    apart = dataclasses.replace(SHARED, per_light=True)
    lamps, whole = (render_view(lit_scene(), each, light_seed=5) for each in (apart, SHARED))
    assert lamps.lights_rgb is not None
    np.testing.assert_array_equal(sum_of_lights(lamps.lights_rgb), lamps.radiance_rgb)
    assert psnr_log_db(lamps.radiance_rgb, whole.radiance_rgb) > whole.noise_floor_db


def _splatted(resolution: int, values: Any, pixels: Any, active: bool = True) -> NDArray:
    """Return the picture [R^2, 3] of values [3, N] that are added to pixels."""
    splats = Splats(resolution, SplatUnit(lamp_over_floor()))
    color = mi.Color3f(*(np.asarray(channel, np.float32) for channel in values))
    splats.add(color, mi.UInt32(np.asarray(pixels, np.uint32)), mi.Bool(active))
    return read_back(splats.picture()).reshape(-1, 3)


def test_splats_add_up_in_any_order_to_the_nearest_unit_and_what_no_sum_can_hold_shows() -> None:
    rng = np.random.default_rng(1)
    values = rng.exponential(size=(3, 5000)) * 10.0 ** rng.uniform(-6, 3, 5000)
    pixels, order = rng.integers(0, 16, 5000), rng.permutation(5000)
    found = _splatted(4, values, pixels)
    np.testing.assert_array_equal(found, _splatted(4, values[:, order], pixels[order]))
    expected = np.zeros((16, 3))
    np.add.at(expected, pixels, values.T)
    # Float32 values are off by a half of 2^-24 of themselves, units by 5 / 2^33 for each splat.
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-5)
    # Cut off instead, dim light would be lost: 0.75 of a unit would be none, a thousand times.
    unit = SplatUnit(lamp_over_floor()).value
    for units, counted in ((0.25, 0.0), (0.75, 1000.0)):
        dim = _splatted(1, np.full((3, 1000), units * unit), np.zeros(1000))
        np.testing.assert_array_equal(dim / unit, counted)
    for value in (np.inf, np.nan, 1e9):
        for channel in range(3):
            two = np.full((3, 2), 0.25)
            two[channel, 1] = value
            broken = np.isnan(_splatted(2, two, [0, 1]))
            np.testing.assert_array_equal(broken.all(axis=1), [False, True, False, False])
        assert not _splatted(1, np.full((3, 1), value), [0], active=False).any()


def test_a_unit_is_a_power_of_two_that_goes_with_the_light() -> None:
    for radiance in (1e-30, 1e-3, 1.0, 4095.0, 1e12):
        unit = SplatUnit(lamp_over_floor(radiance)).value
        assert np.frexp(unit)[0] == 0.5
        if radiance > 1e-27:  # dimmer ones are coarse: nothing that half floats show
            assert 2**33 <= np.float32(radiance) / unit < 2**34
            assert SplatUnit(lamp_over_floor(2 * radiance)).value == 2 * unit
        assert np.isfinite(np.float32(1 / unit))


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
    scene, resolution = lamp_over_floor(), 24
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


def _guided(tracer: VectorTracer) -> VectorTracer:
    guided = tracer.with_guide()
    assert guided._scene.guide is not None, "there is something to learn"
    return guided


def _below_a_sky() -> Scene:
    """A mirror that throws a lamp's light and the sky's on a rough floor."""
    floor, smooth_metal = material(diffuse=0.8), material(specular=1.0, roughness=0.05)
    mirror = quad([[-1, 1, 0], [1, 1, 0], [1, 1, 1], [-1, 1, 1]], smooth_metal)
    lamp = light([[0, -0.5, 1], [0.2, -0.5, 1], [0, -0.3, 1]], 10.0)
    return join([textured_floor(floor), mirror, lamp], eye=(0, -2, 1.5), sky=smooth())


@pytest.mark.usefixtures("unrecorded")
@pytest.mark.parametrize(
    ("scene", "share"),
    [(mirrors(), 0.95), (lit_by_a_mirror(0.1), 0.5), (_below_a_sky(), 0.5)],
    ids=["mirrors", "small lamp", "sky"],
)
def test_guided_pictures_show_the_same_light(
    scene: Scene, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much is guided: the weights of all three strategies go by the mixture.

    Where light paths took the density of the BRDF alone for that of the camera paths, the mean of
    the small lamp's scene was 23 % too high.
    """
    monkeypatch.setattr("pipeline.renders.guide_table._SHARE", share)
    tracer = _tracer(scene)
    plain = render_passes(tracer, scene, passes=12)
    guided = render_passes(_guided(tracer), scene, passes=12, first_seed=700)
    assert_same_light(guided, plain)


def test_guided_camera_paths_have_less_noise_where_a_mirror_is_the_lamp() -> None:
    """Roulette by the throughput f / c would end the guided paths, and take away the gain.

    Measured: 0.52 of the variance, and 2.1 times as much with such roulette.
    """
    scene = lit_by_a_mirror(0.3)
    tracer = _tracer(scene)
    plain, guided = (
        np.square(render_blocks(scene, tracer=each, block=1, passes=10).error).mean()
        for each in (tracer, _guided(tracer))
    )
    assert guided < 0.8 * plain


def test_a_matt_scene_has_nothing_to_learn() -> None:
    floor = quad(GUIDED_FLOOR, material(diffuse=0.6))
    scene = join([floor, light(GUIDED_LAMP, 30.0)], eye=(0, -2, 1))
    assert _tracer(scene).with_guide()._scene.guide is None
    nothing = np.zeros(0, np.int64)
    cells = GuideCells(np.random.default_rng(5).normal(size=(9, 3, 3)))
    assert learn(cells, nothing, nothing, np.zeros(0)) is None


def test_only_views_that_miss_their_floor_are_guided(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene is learnt once, whatever its views and lights, and not for views that need little."""
    learn = Mock(wraps=vector_tracer._learn_guide)
    monkeypatch.setattr(vector_tracer, "_learn_guide", learn)
    scene = mirrors()
    camera = camera_of(scene, 16)
    for floor_db, max_spp, times in ((1.0, 512, 0), (90.0, 256, 0), (90.0, 512, 1)):
        settings = view_settings(8, resolution=16, min_mean_radiance=0.0, per_light=True)
        settings = dataclasses.replace(settings, noise_floor_db=floor_db, max_spp=max_spp)
        renderer = SceneRenderer(scene, settings)
        for seed in range(2):
            renderer.render_view(camera.c2w, camera.fov_deg, seed)
        assert learn.call_count == times


def test_lights_apart_share_a_table_and_add_up() -> None:
    """What was learnt of both lamps guides the paths of each: unbiased, as any table is."""
    lamps = [light(np.array(GUIDED_LAMP) - [1.8 * k, 0, 0.2 * k], 30.0 - 20 * k) for k in range(2)]
    parts = [
        quad(GUIDED_FLOOR, material(diffuse=0.6)),
        quad(GUIDED_WALL, material(specular=0.9, roughness=0.2)),
    ]
    both = join([*parts, *lamps], eye=(0.3, -2.4, 1.0), target=(0, 0.6, 0.4), fov_deg=50)
    tracer = _tracer(both)
    alone = [tracer.only_light(row).with_guide() for row in (2, 3)]
    assert alone[0]._scene.guide is alone[1]._scene.guide is _guided(tracer)._scene.guide
    pictures = [
        render_passes(each, both, passes=12, first_seed=12 * k) for k, each in enumerate(alone)
    ]
    plain = render_passes(tracer, both, passes=12, first_seed=1000)
    assert_same_light(np.sum(pictures, axis=0), plain)


def _table(peaks: NDArray[np.int64]) -> Any:
    """Return a table of one triangle whose front knows only the bins `peaks`."""
    cells = GuideCells(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]))
    shares = np.bincount(peaks, minlength=BINS)[None] / len(peaks)
    rows = (np.arange(len(cells.facing)) % 2).astype(np.int64)
    return GuideTable(cells, rows, apportion_entries(shares))


def _twin(directions: NDArray[np.float64], peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the density by the textbook: share of the bin over its part of the square, d^-3."""
    length = np.abs(directions).sum(axis=1)
    square = directions[:, :2] / length[:, None]
    signs = np.where(square >= 0, 1.0, -1.0)
    square = np.where(directions[:, 2:] < 0, (1 - np.abs(square[:, ::-1])) * signs, square)
    column, line = np.clip(((square + 1) * SIDE / 2).astype(int), 0, SIDE - 1).T
    shares = np.bincount(peaks, minlength=BINS) / len(peaks)
    return np.asarray(shares[line * SIDE + column] * BINS / 4 / length**3)


def test_directions_are_drawn_by_the_density_which_is_that_of_a_slow_twin() -> None:
    """It integrates to one. As many directions are in each bin as the table says, and spread in it:
    by moments of what is drawn."""
    rng = np.random.default_rng(2)
    peaks, count = rng.integers(0, 1024, 256), 1 << 18
    u = mi.Point2f(*(rng.random((2, count)).astype(np.float32)))
    guidance = Guidance(row=dr.opaque(mi.UInt32, 1), share=mi.Float(0.5), table=_table(peaks))
    uniform = rng.normal(size=(count, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    rounded = uniform.astype(np.float32)
    pdf = np.array(guidance.pdf(mi.Vector3f(*rounded.T.copy()), mi.Bool(True)))
    twin = _twin(rounded.astype(np.float64), peaks)
    # Directions within roundings of a bin's rim may fall on either side: one in ten thousand.
    assert np.isclose(pdf, twin, rtol=1e-4).mean() > 0.9999
    integral = 4 * np.pi * pdf.astype(np.float64)
    assert abs(integral.mean() - 1) < 5 * integral.std() / np.sqrt(len(integral))
    drawn = guidance.sample(u, mi.Bool(True))
    found = np.bincount(np.array(bin_of(drawn)[0]), minlength=1024)
    expected = np.bincount(peaks, minlength=1024) / 256 * count
    there = expected > 0
    assert found[~there].sum() < 1e-4 * count  # roundings at a bin's rim
    chi_sq = (np.square(found - expected)[there] / expected[there]).sum()
    freedom = there.sum() - 1
    assert chi_sq < freedom + 5 * np.sqrt(2 * freedom)
    directions = np.array(drawn).T.astype(np.float64)
    # The mean of g / density is the integral of g over the bins that are there.
    pdf = np.array(guidance.pdf(drawn, mi.Bool(True)), np.float64)
    inside = _twin(uniform, peaks) > 0
    for moment in (np.ones_like, np.square):
        by_drawn = (moment(directions[:, 0]) / pdf)[pdf > 0]
        by_twin = 4 * np.pi * moment(uniform[:, 0]) * inside
        error = np.hypot(by_drawn.std(), by_twin.std()) / np.sqrt(count)
        assert abs(by_drawn.mean() - by_twin.mean()) < 5 * error


def test_what_is_no_direction_still_has_a_bin() -> None:
    """As an integer it is another one on each kind of processor: one read beyond the table, and
    crashed or not by where that ended in memory."""
    for length in (0.0, np.nan, np.inf):
        for direction in ((length, 0, 0), (0, length, 0), (0, 0, -length), (length,) * 3):
            assert int(np.array(bin_of(mi.Vector3f(*direction))[0])[0]) < 1024


def test_a_cell_that_learnt_nothing_is_not_guided() -> None:
    nothing = Guidance(row=mi.UInt32(0), share=mi.Float(0), table=_table(np.arange(4)))
    unguided = mi.Float(0.1, 0.3, 1e9)
    direction = mi.Vector3f(0, 0, 1)
    mixed = nothing.mixture(unguided, direction, mi.Bool(True))
    np.testing.assert_array_equal(np.array(mixed), np.array(unguided))


def test_a_table_is_bounded_however_many_cells_have_photons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At most so many rows on each of 4 levels: a row takes as many photons as that needs."""
    monkeypatch.setattr(guide_table, "_MOST_ROWS", 200)
    monkeypatch.setattr(guide_table, "_LEAST_PHOTONS", 1)
    rng = np.random.default_rng(3)
    far_apart = rng.uniform(0, 10, (2000, 1, 3)) + 0.3 * rng.normal(size=(2000, 3, 3))
    cells = GuideCells(far_apart)
    count = 100_001
    hit_cells = rng.integers(0, len(cells.facing), count)
    bins = rng.integers(0, BINS, count)
    table = guide_table.learn(cells, hit_cells, bins, rng.exponential(size=count))
    assert table is not None
    assert len(table.densities) <= (1 + 4 * 200) * BINS


def test_shares_become_whole_numbers_that_add_up() -> None:
    shares = np.random.default_rng(4).exponential(size=(50, BINS)) ** 4
    shares /= shares.sum(axis=1, keepdims=True)
    counts = apportion_entries(shares)
    assert (counts.sum(axis=1) == ENTRIES).all()
    assert np.abs(counts - shares * ENTRIES).max() < 1 + 1e-6  # rounded at both ends
