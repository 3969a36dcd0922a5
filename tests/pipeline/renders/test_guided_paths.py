"""Path guiding: the density of its table, and the same light as without."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import guide_table, vector_tracer
from pipeline.renders.guide_table import (
    BINS,
    ENTRIES,
    SIDE,
    Guidance,
    GuideCells,
    GuideTable,
    Photons,
    apportion_entries,
    bin_of,
    learn,
)
from pipeline.renders.kernel_scene import KernelScene
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.vector_tracer import VectorTracer
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import (
    assert_same_light,
    camera_of,
    render_blocks,
    render_passes,
)
from tests.pipeline.renders.scene_kit import (
    GUIDED_FLOOR,
    GUIDED_LAMP,
    GUIDED_WALL,
    join,
    light,
    lit_by_a_mirror,
    material,
    mirrors,
    quad,
)
from tests.sky_maps import smooth

pytestmark = pytest.mark.usefixtures("llvm")


def _tracer(scene: Scene) -> VectorTracer:
    return VectorTracer(scene, max_depth=10, rr_depth=2)


def _guided(tracer: VectorTracer) -> VectorTracer:
    guided = tracer.with_guide()
    assert guided._scene.guide is not None, "there is something to learn"
    return guided


def _below_a_sky() -> Scene:
    """A mirror that throws a lamp's light and the sky's on a rough floor."""
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.8))
    mirror = quad(
        [[-1, 1, 0], [1, 1, 0], [1, 1, 1], [-1, 1, 1]], material(specular=1.0, roughness=0.05)
    )
    lamp = light([[0, -0.5, 1], [0.2, -0.5, 1], [0, -0.3, 1]], 10.0)
    return join([floor, mirror, lamp], eye=(0, -2, 1.5), sky=smooth())


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
    scene = join(
        [quad(GUIDED_FLOOR, material(diffuse=0.6)), light(GUIDED_LAMP, 30.0)], eye=(0, -2, 1)
    )
    assert _tracer(scene).with_guide()._scene.guide is None
    nothing = np.zeros(0, np.int64)
    cells = GuideCells(np.random.default_rng(5).normal(size=(9, 3, 3)))
    assert learn(cells, Photons(cell=nothing, bin=nothing, power=np.zeros(0))) is None


def test_only_views_that_miss_their_floor_are_guided(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene is learnt once, whatever its views and lights, and not for views that need little."""
    learnt = list[Scene]()
    learn = vector_tracer._learn_guide

    def counted(record: Scene, scene: KernelScene) -> GuideTable | None:
        learnt.append(record)
        return learn(record, scene)

    monkeypatch.setattr(vector_tracer, "_learn_guide", counted)
    scene = mirrors()
    camera = camera_of(scene, 16)
    for floor_db, max_spp, times in ((1.0, 512, 0), (90.0, 256, 0), (90.0, 512, 1)):
        settings = RenderSettings(
            resolution=16, noise_floor_db=floor_db, min_spp=8, max_spp=max_spp,
            min_mean_radiance=0.0,
            per_light=True,
        )  # fmt: skip
        renderer = SceneRenderer(scene, settings)
        for seed in range(2):
            renderer.render_view(camera.c2w, camera.fov_deg, seed)
        assert len(learnt) == times


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


def _guidance() -> Any:
    return Guidance(row=dr.opaque(mi.UInt32, 1), share=mi.Float(0.5))


def _twin(directions: NDArray[np.float64], peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the density by the textbook: share of the bin over its part of the square, d^-3."""
    length = np.abs(directions).sum(axis=1)
    square = directions[:, :2] / length[:, None]
    signs = np.where(square >= 0, 1.0, -1.0)
    square = np.where(directions[:, 2:] < 0, (1 - np.abs(square[:, ::-1])) * signs, square)
    column, line = np.clip(((square + 1) * SIDE / 2).astype(int), 0, SIDE - 1).T
    shares = np.bincount(peaks, minlength=BINS) / len(peaks)
    return np.asarray(shares[line * SIDE + column] * BINS / 4 / length**3)


def test_the_density_is_that_of_a_slow_twin_and_integrates_to_one() -> None:
    rng = np.random.default_rng(1)
    peaks = rng.integers(0, 1024, 256)
    directions = rng.normal(size=(1 << 18, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions.astype(np.float32)
    pdf = np.array(_table(peaks).pdf(_guidance(), mi.Vector3f(*directions.T.copy()), mi.Bool(True)))
    expected = _twin(directions.astype(np.float64), peaks)
    # Directions within roundings of a bin's rim may fall on either side: one in ten thousand.
    assert np.isclose(pdf, expected, rtol=1e-4).mean() > 0.9999
    integral = 4 * np.pi * pdf.astype(np.float64)
    assert abs(integral.mean() - 1) < 5 * integral.std() / np.sqrt(len(integral))


def test_directions_are_drawn_by_the_density() -> None:
    """As many in each bin as the table says, and spread in it: by moments of what is drawn."""
    rng = np.random.default_rng(2)
    peaks, count = rng.integers(0, 1024, 256), 1 << 18
    u = mi.Point2f(*(rng.random((2, count)).astype(np.float32)))
    table = _table(peaks)
    drawn = table.sample(_guidance(), u, mi.Bool(True))
    found = np.bincount(np.array(bin_of(drawn)[0]), minlength=1024)
    expected = np.bincount(peaks, minlength=1024) / 256 * count
    there = expected > 0
    assert found[~there].sum() < 1e-4 * count  # roundings at a bin's rim
    chi_sq = (np.square(found - expected)[there] / expected[there]).sum()
    freedom = there.sum() - 1
    assert chi_sq < freedom + 5 * np.sqrt(2 * freedom)
    directions = np.array(drawn).T.astype(np.float64)
    # The mean of g / density is the integral of g over the bins that are there.
    pdf = np.array(table.pdf(_guidance(), drawn, mi.Bool(True)), np.float64)
    uniform = rng.normal(size=(count, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
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
    nothing = Guidance(row=mi.UInt32(0), share=mi.Float(0))
    unguided = mi.Float(0.1, 0.3, 1e9)
    direction = mi.Vector3f(0, 0, 1)
    mixed = _table(np.arange(4)).mixture(nothing, unguided, direction, mi.Bool(True))
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
    photons = guide_table.Photons(
        cell=rng.integers(0, len(cells.facing), count),
        bin=rng.integers(0, BINS, count),
        power=rng.exponential(size=count),
    )
    table = guide_table.learn(cells, photons)
    assert table is not None
    assert len(table._densities) <= (1 + 4 * 200) * BINS


def test_shares_become_whole_numbers_that_add_up() -> None:
    shares = np.random.default_rng(4).exponential(size=(50, BINS)) ** 4
    shares /= shares.sum(axis=1, keepdims=True)
    counts = apportion_entries(shares)
    assert (counts.sum(axis=1) == ENTRIES).all()
    assert np.abs(counts - shares * ENTRIES).max() < 1 + 1e-6  # rounded at both ends
