"""Laws that every family of surfaces keeps: drawn as stated, lawful, tileable, reproducible.

Texels, finishes, what is laid and made of them, and which are drawn.
"""

import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_templates.exact import Numbers
from scene_templates.layout import RGB
from scene_templates.scene_maps import TexturedLook, TextureSettings, draw_look
from scene_templates.surfaces.maps import (
    MOST_ALBEDO,
    Finish,
    SurfaceDraws,
    SurfaceMaps,
    Texels,
    stones,
)
from scene_templates.surfaces.procedural_textures import (
    OUR_SURFACES,
    SURFACES,
    SurfaceMapSettings,
    draw_surface,
    exceeded_by,
    lay_rows,
)
from storage.seeds import rng_for
from storage.settings.overrides import apply_overrides
from tests.for_each import for_each
from tests.scene_templates.statistics import (
    choices,
    merged,
    require_plausible,
    share,
    stated_table,
    uniform,
    with_draws,
)

ALBEDO = (0.02, 0.9)


def _surface(family: str, seed: int, **changes: Any) -> SurfaceMaps:
    settings = apply_overrides(SurfaceMapSettings(families=(family,), size=64), changes)
    return draw_surface(rng_for(seed, "surface"), settings)


def _all_three(maps: SurfaceMaps) -> NDArray[np.float32]:
    return np.concatenate([maps.diffuse_rgb, maps.specular_rgb, maps.roughness], axis=-1)


@for_each("family", OUR_SURFACES)
def test_parameters_are_distributed_as_stated(family: str) -> None:
    """At one texel, where a family draws the same and makes no picture."""

    def made(seed: int, natural_share: float) -> SurfaceDraws:
        rng = rng_for(seed, "surface", int(natural_share))
        draws = SurfaceDraws(rng, natural_share=natural_share, albedo=ALBEDO)
        SURFACES[family](draws, Texels(1))
        return draws

    for natural_share in (0.0, 1.0):
        found = merged(made(seed, natural_share).made for seed in range(100))
        assert len(found) >= 7
        require_plausible(stated_table(found))


@for_each("family", OUR_SURFACES)
def test_albedos_and_roughness_are_lawful(family: str) -> None:
    for size in (1, 2, 8):
        maps = _surface(family, 0, size=size)
        assert np.isfinite(_all_three(maps)).all()
        assert (maps.diffuse_rgb.astype(float) + maps.specular_rgb).max() <= 1
    for seed in range(2):
        maps = _surface(family, seed, natural_share=float(seed % 2), roughness_clip=[0.2, 0.8])
        assert maps.diffuse_rgb.shape == maps.specular_rgb.shape == (64, 64, 3)
        assert maps.roughness.shape == (64, 64, 1)
        found = _all_three(maps)
        assert found.dtype == np.float32 and np.isfinite(found).all()
        assert maps.diffuse_rgb.min() >= 0 and maps.specular_rgb.min() >= 0
        # no tolerance: MOST_ALBEDO leaves far more room than float32 rounds
        assert (maps.diffuse_rgb.astype(float) + maps.specular_rgb).max() <= 1
        assert maps.roughness.min() >= np.float32(0.2)
        assert maps.roughness.max() <= np.float32(0.8)
        assert maps.diffuse_rgb.std() + maps.specular_rgb.std() > 0.002, "more than one value"


class Shifted(Texels):
    """Texels whose map is seen from elsewhere on the torus."""

    moved = (1 + 3 / 64, 2 - 5 / 64)

    @property
    def u(self) -> Numbers:
        return super().u + self.moved[0]

    @property
    def v(self) -> Numbers:
        return super().v + self.moved[1]


@for_each("family", OUR_SURFACES)
def test_every_surface_repeats_in_both_directions(family: str) -> None:
    """Seen three texels further right, five further down and whole turns away: the same, rolled."""

    def made(texels: Texels) -> Finish:
        draws = SurfaceDraws(rng_for(7, "surface"), natural_share=1.0, albedo=ALBEDO)
        return SURFACES[family](draws, texels)

    here, there = made(Texels(64)), made(Shifted(64))
    whole = np.zeros((64, 64, 1))
    for one, other in (
        (here.diffuse_rgb, there.diffuse_rgb),
        (here.specular_rgb, there.specular_rgb),
        (here.roughness[..., None], there.roughness[..., None]),
    ):
        # v is up and rows go down: down by five rows is v - 5 / 64
        rolled = np.roll(one + whole, (-5, -3), axis=(0, 1))
        # u and v round to 2e-16, lattices of up to 64 cells and steep edges enlarge that
        assert np.abs(rolled - (other + whole)).max() < 1e-9, family


@for_each("family", OUR_SURFACES)
def test_the_same_seed_is_the_same_surface_at_every_size(family: str) -> None:
    """A finer map, averaged, is the coarse one but for what the coarse one cannot show."""
    (coarse, draws), (fine, again) = (
        with_draws(_surface, family, 0, size=size) for size in (128, 256)
    )
    assert draws == again
    averaged = fine.diffuse_rgb.reshape(128, 2, 128, 2, 3).mean(axis=(1, 3), dtype=float)
    off = np.abs(averaged - coarse.diffuse_rgb).mean()
    # brushed metal, whose finest scratches 128 texels leave out, has the most: measured 0.26
    # of its contrast; of other families at most 0.14. An unrelated surface has about 1.1.
    assert off < 0.3 * max(averaged.std(), 0.01)
    assert np.abs(averaged.mean((0, 1)) - coarse.diffuse_rgb.mean((0, 1))).max() < 0.01


DIGESTS = {
    "checker": "630edb782c4157b7",
    "stripes": "2ddbcf9c75c667bc",
    "bricks": "426330ceedb02af7",
    "tiles": "58f24c021d19aef5",
    "hexagons": "01ed46daf78d270b",
    "planks": "41930aabb0cae981",
    "wood": "8b8054e517b9d8a8",
    "marble": "5d3264887d077ca0",
    "terrazzo": "f102b3600651b716",
    "cobbles": "6353daf0e7323029",
    "concrete": "d5bbe291d32df3d6",
    "rust": "b8c1e57350f99444",
    "brushed_metal": "8a7697dae1434036",
    "fabric": "12163ad4869a54ef",
    "camouflage": "f9280b2d0a95bc48",
}
"""Of the maps of four seeds; a surface that is drawn otherwise is another one."""


@pytest.mark.parametrize("family", OUR_SURFACES)
def test_bytes_are_the_same_everywhere(family: str) -> None:
    """Also as other processors compute them: tests/elsewhere.py. Seeds decide them all."""
    made = [_all_three(_surface(family, seed)).tobytes() for seed in range(4)]
    assert hashlib.sha256(b"".join(made)).hexdigest()[:16] == DIGESTS[family]
    assert len(set(made)) == 4


def test_the_first_row_is_the_top_and_the_first_column_the_left() -> None:
    texels = Texels(4)
    assert texels.u.tolist() == [[0.125, 0.375, 0.625, 0.875]]
    assert texels.v.ravel().tolist() == [0.875, 0.625, 0.375, 0.125]


def test_noise_has_the_stated_deviation_and_prefers_no_direction() -> None:
    found = np.stack([Texels(64).noise(rng_for(seed, "noise"), (8, 8)) for seed in range(200)])
    # 64 cells in each of 200 fields: the mean of 12,800 numbers of deviation 0.4, five times over
    assert abs(found.mean()) < 5 * 0.4 / np.sqrt(12800)
    assert 0.35 < found.std() < 0.45
    assert np.abs(found).max() < 2
    # Slopes along u, v and both diagonals have the same mean square, by the same covariance.
    along = [np.square(found - np.roll(found, 1, axis)).mean() for axis in (1, 2)]
    # 12,800 independent cells: a mean square is known to about 1 %
    assert along[0] == pytest.approx(along[1], rel=0.05)
    diagonals = [np.square(found - np.roll(found, (1, step), (1, 2))).mean() for step in (1, -1)]
    assert diagonals[0] == pytest.approx(diagonals[1], rel=0.05)
    assert sum(diagonals) / 2 == pytest.approx(sum(along), rel=0.1)


def test_octaves_that_texels_cannot_show_are_left_out() -> None:
    def noise(size: int, octaves: int) -> np.ndarray:
        return Texels(size).noise(rng_for(0, "noise"), (4, 8), octaves=octaves)

    np.testing.assert_array_equal(noise(64, 2), noise(64, 9))  # 8 and 16 cells of 4 texels
    assert np.abs(noise(64, 1) - noise(64, 2)).max() > 0.01
    assert (noise(16, 9) == 0).all()


@pytest.mark.parametrize("jitter", [0.5, 1.0])
def test_the_nearest_stone_is_the_nearest(jitter: float) -> None:
    """Against all points and their copies on the eight maps around."""
    cells, texels = 5, Texels(32)
    found = stones(texels, rng_for(1, "stones"), cells, jitter=jitter)
    offsets = 0.5 + jitter * (rng_for(1, "stones").random((cells, cells, 2)) - 0.5)
    row, column = np.mgrid[:cells, :cells]
    points = np.stack([column + offsets[..., 0], row + offsets[..., 1]], axis=-1).reshape(-1, 2)
    steps = np.array([(x, y) for x in (-cells, 0, cells) for y in (-cells, 0, cells)])
    copies = (points[:, None] + steps).reshape(-1, 2)
    places = np.stack(np.broadcast_arrays(texels.u, texels.v), axis=-1) * cells
    away = np.sqrt(np.square(places[:, :, None] - copies).sum(axis=-1))
    order = np.argsort(away, axis=-1)
    np.testing.assert_array_equal(found.index, order[..., 0] // len(steps))
    nearest = np.take_along_axis(away, order[..., :2], axis=-1)
    np.testing.assert_allclose(found.nearest, nearest[..., 0], atol=1e-12)
    # the second nearest may be two squares away, where 3 x 3 squares do not look; it is then
    # farther than any of their points, in few texels and by little
    off = np.abs(found.gap - (nearest[..., 1] - nearest[..., 0]))
    assert (off > 1e-12).mean() < 0.02 and off.max() < 0.3


def _finish(base: RGB, *, specular: float, roughness: float, metal: bool) -> Finish:
    """Return the finish that is drawn with this base colour."""
    draws = SurfaceDraws(np.random.default_rng(0), natural_share=0.0, albedo=(0.0, 1.0))
    draws.colour = lambda *_: np.array(base)  # type: ignore[method-assign]
    ranges = {"specular": (specular, specular), "roughness": (roughness, roughness)}
    return draws.finish("it", low=base, high=base, metal=metal, **ranges)


RED = _finish((0.8, 0.1, 0.0), specular=0.25, roughness=0.6, metal=False)
GOLD = _finish((0.9, 0.7, 0.3), specular=0.9, roughness=0.2, metal=True)


def test_finishes_are_grey_but_for_metal_mixed_by_area_and_toned() -> None:
    # products of two or three numbers, rounded to float64
    np.testing.assert_allclose(RED.diffuse_rgb, [0.6, 0.075, 0.0], rtol=1e-15)
    np.testing.assert_allclose(RED.specular_rgb, [0.25, 0.25, 0.25], rtol=1e-15)
    np.testing.assert_allclose(GOLD.diffuse_rgb, [0.09, 0.07, 0.03], rtol=1e-14)
    np.testing.assert_allclose(GOLD.specular_rgb, [0.81, 0.63, 0.27], rtol=1e-15)
    white = _finish((1.0, 1.0, 2.0), specular=1.0, roughness=0.5, metal=False)
    assert (white.diffuse_rgb + white.specular_rgb).max() < 1
    assert white.specular_rgb.max() == MOST_ALBEDO
    half = RED.covered(GOLD, np.array([[0.0, 1.0], [0.5, 0.5]]))
    np.testing.assert_array_equal(half.diffuse_rgb[0, 0], RED.diffuse_rgb)
    np.testing.assert_allclose(half.specular_rgb[0, 1], GOLD.specular_rgb, rtol=1e-15)
    mean_rgb = (RED.diffuse_rgb + GOLD.diffuse_rgb) / 2
    np.testing.assert_allclose(half.diffuse_rgb[1, 0], mean_rgb, rtol=1e-15)
    # GGX widths 0.36 and 0.04 have the mean 0.2
    assert half.roughness[1, 1] == pytest.approx(0.2**0.5, rel=1e-15)
    toned, dimmed = RED.toned(0.5), RED.dimmed(0.5)
    np.testing.assert_array_equal(toned.specular_rgb, RED.specular_rgb)
    np.testing.assert_array_equal(dimmed.specular_rgb, RED.specular_rgb / 2)
    np.testing.assert_array_equal(toned.diffuse_rgb, dimmed.diffuse_rgb)
    np.testing.assert_array_equal(RED.toned(7.0).diffuse_rgb, RED.diffuse_rgb)
    np.testing.assert_array_equal(RED.toned(-1.0).diffuse_rgb, np.zeros(3))
    assert RED.rougher(0.7).roughness == pytest.approx(1.3)


def _shares(family: str, seed: int, first: str, second: str) -> float:
    """Return how much of a surface is `second`, from the colours of both."""
    settings = SurfaceMapSettings(families=(family,), size=256, natural_share=0.0)
    maps, draws = with_draws(draw_surface, rng_for(seed, "laid"), settings)
    ends = [
        np.array(draws[f"{name}: any colour"][0]) * (1 - draws[f"{name}: specular share"][0])
        for name in (first, second)
    ]
    channel = int(np.argmax(np.abs(ends[1] - ends[0])))
    mean = maps.diffuse_rgb[..., channel].mean(dtype=float)
    return float((mean - ends[0][channel]) / (ends[1][channel] - ends[0][channel]))


def test_checkers_are_half_and_half_and_bands_have_their_share() -> None:
    for seed in range(5):
        # edges fall on texel borders or are split evenly between both sides
        dark_share = _shares("checker", seed, "light square", "dark square")
        assert dark_share == pytest.approx(0.5, abs=0.002)
    for seed in range(8):
        settings = SurfaceMapSettings(families=("stripes",), size=256, natural_share=0.0)
        _, draws = with_draws(draw_surface, rng_for(seed, "laid"), settings)
        stated = draws["share of the bands"][0]
        # two edges a band, each known to a sixteenth of a texel of at least 13 a band
        assert _shares("stripes", seed, "ground", "band") == pytest.approx(stated, abs=0.02)


def test_pieces_tile_the_map() -> None:
    rows, columns, size = 4, 3, 96
    pieces = lay_rows(Texels(size), rows, columns, np.array([0.0, 0.5, 0.25, 0.9]))
    counts = np.zeros((rows, columns), int)
    np.add.at(counts, (pieces.row, pieces.column), 1)
    # 24 rows and 32 columns of texels a piece, shifted by a share of a texel at most
    assert np.abs(counts - 24 * 32).max() <= 24
    assert pieces.row[0, 0] == rows - 1, "the top row of a picture is the last course"
    assert pieces.edge.max() <= 0.5 / rows
    # the share of texels nearer to an edge than d, of a piece a x b: 1 - (1 - 2d/a)(1 - 2d/b)
    d = 0.03
    expected = 1 - (1 - 2 * d * columns) * (1 - 2 * d * rows)
    assert (pieces.edge < d).mean() == pytest.approx(expected, abs=0.02)


@for_each("share", [0.0, 0.1, 0.5, 1.0])
def test_a_level_is_exceeded_by_its_share(share: float) -> None:
    noise = Texels(64).noise(rng_for(0, "noise"), (4, 4), octaves=3)
    # of 4,096 values, the one at the level itself does not exceed it
    assert (noise > exceeded_by(noise, share)).mean() == pytest.approx(share, abs=2 / 4096)


def test_ours_are_drawn_equally_often_and_natural_ones_as_often_as_stated() -> None:
    settings = SurfaceMapSettings(size=1, natural_share=0.4)
    found = [with_draws(draw_surface, rng_for(seed, "surface"), settings) for seed in range(400)]
    natural = [draws["natural colours"] == (True,) for _, draws in found]
    families = [maps.source.name for maps, _ in found]
    even = dict.fromkeys(OUR_SURFACES, 1.0)
    require_plausible({"families": choices(families, even), "natural": share(natural, 0.4)})
    assert SurfaceMapSettings().families == OUR_SURFACES == tuple(SURFACES)
    assert len(OUR_SURFACES) >= 10


def test_colours_that_are_not_natural_are_in_the_stated_range() -> None:
    settings = SurfaceMapSettings(
        families=("checker",), size=64, natural_share=0.0, albedo=(0.4, 0.4)
    )
    maps, draws = with_draws(draw_surface, rng_for(0, "surface"), settings)
    assert "light square: any colour" in draws
    # diffuse = (1 - share) x base: the same in every channel, as the base colour is
    assert np.ptp(maps.diffuse_rgb, axis=-1).max() == 0


SETTINGS = TextureSettings(
    share=0.4, surfaces=SurfaceMapSettings(families=("checker", "stripes"), size=8)
)


def _looks(settings: TextureSettings, count: int) -> list[TexturedLook | None]:
    return [draw_look(rng_for(0, "texture", number), settings) for number in range(count)]


def test_looks_are_drawn_as_stated() -> None:
    drawn = _looks(SETTINGS, 2000)
    looks = [look for look in drawn if look is not None]
    require_plausible(
        {
            "share": share([look is not None for look in drawn], 0.4),
            "families": choices(
                [look.maps.source.name for look in looks], {"checker": 1.0, "stripes": 1.0}
            ),
            "width": uniform([look.tile_m for look in looks], *SETTINGS.tile_m),
            "turns": choices([look.quarter_turns for look in looks], dict.fromkeys(range(4), 1.0)),
            "shift along u": uniform([look.shift_uv[0] for look in looks], 0, 1),
            "shift along v": uniform([look.shift_uv[1] for look in looks], 0, 1),
        }
    )


def test_another_share_changes_no_texture_that_is_there_still() -> None:
    few, all_ = _looks(SETTINGS, 40), _looks(dataclasses.replace(SETTINGS, share=1.0), 40)
    for one, other in zip(few, all_, strict=True):
        assert other is not None
        if one is not None:
            assert one.tile_m == other.tile_m
            assert np.array_equal(one.maps.diffuse_rgb, other.maps.diffuse_rgb)


def test_a_quarter_turn_turns_the_picture_counter_clockwise() -> None:
    look = draw_look(rng_for(1, "texture"), dataclasses.replace(SETTINGS, share=1.0))
    assert look is not None
    turned = dataclasses.replace(look, quarter_turns=1, tile_m=2.0, shift_uv=(0.0, 0.0))
    # What lay to the right (+x) now lies above (+y): u grows with y, and v against x.
    assert np.allclose(turned.uv(np.array([[0.0, 1.0], [1.0, 0.0]])), [[0.5, 0], [0, -0.5]])
