"""Textures, skies and normal maps: looked up as records say, drawn by the density stated."""

import dataclasses
import tracemalloc
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import kernel_scene
from pipeline.renders.light_tables import (
    SkyTable,
    alias_rows,
    alias_table,
    peaked_radiance,
    sky_share,
)
from pipeline.renders.surface_table import KernelTextures
from pipeline.renders.tracer import load_tracer
from pipeline.renders.vector_tracer import VectorTracer
from scene_templates.rotations import uniform_rotation
from storage.denoiser import Features
from storage.errors import TrilightError
from storage.raycast import first_hits
from storage.records.lights import light_sources
from storage.records.lookup import (
    FLAT,
    LEAST_Z,
    environment_values,
    mapped_normals,
    texture_values,
    u_directions,
)
from storage.records.passes import view_passes
from storage.records.scene import Scene
from storage.records.texture import MAX_SIDE, Environment, Texture, row_solid_angles
from tests.pipeline.renders.sampling import (
    assert_same_light,
    camera_of,
    lambert_irradiance,
    render_passes,
)
from tests.pipeline.renders.scene_kit import (
    SKY_LAMP,
    furnace,
    join,
    light,
    mapped,
    material,
    noise_map,
    open_scene,
    quad,
    sphere,
    textured,
    textured_floor,
)
from tests.scenes_by_hand import moved
from tests.sky_maps import as_sky, constant, night, one_sun, six_poles, smooth
from tests.textured_by_hand import bumps
from trilight import render

pytestmark = pytest.mark.usefixtures("llvm")


def test_guides_are_the_lookup_of_the_records() -> None:
    """Coordinates from -1.75 to 1.25 wrap; a diffuse and a specular map of unlike sizes add up."""
    corners = np.array([[(0.8, 0.1, 0.1), (0.1, 0.8, 0.1)], [(0.1, 0.1, 0.8), (0.7, 0.7, 0.1)]])
    maps = noise_map(1, 3, 0, 0.6), Texture(texels=(0.3 * corners).astype(np.float32))
    scene = textured([textured_floor(material(roughness=0.4)), SKY_LAMP], maps, [0, 1, -1])
    scene = _moved(scene, 3.0, np.array([-1.75, -1.75]))
    albedo = _guides(scene).albedo
    rows = np.nan_to_num(first_hits(scene, resolution=32).material)
    wanted = rows[..., 0:3] + rows[..., 3:6]
    # Float32 places of hits: 1e-6 of a coordinate is 7e-6 texels, whose values differ by up to .6.
    # Single pixels at the border of the quad may be met by one and missed by the other.
    assert np.mean(np.abs(albedo - wanted).max(axis=-1) > 2e-5) < 0.01
    assert np.ptp(wanted, axis=(0, 1)).min() > 0.5
    far = _moved(scene, 1.0, np.array([1000.0, -512.0]))
    # The stored coordinates know 1000 to 3e-5: two ten-thousandths of a texel.
    assert np.abs(albedo - _guides(far).albedo).max() < 5e-4


def _guides(scene: Scene) -> Features:
    return load_tracer(scene, max_depth=2, rr_depth=5).features(camera_of(scene, 32), spp=1)


def _moved(scene: Scene, scale: float, shift: NDArray[np.float64]) -> Scene:
    assert scene.uv is not None
    return dataclasses.replace(scene, uv=(scale * scene.uv + shift).astype(np.float32))


def test_a_constant_texture_is_its_constant_in_every_bit() -> None:
    row = material(diffuse=[0.2, 0.4, 0.6], specular=0.3, roughness=0.25)
    one = Texture(texels=np.full((4, 4, 3), np.array([0.2, 0.4, 0.6]), np.float32))
    scene = textured([textured_floor(row), SKY_LAMP], (one,), [0, -1, -1])
    plain = join([textured_floor(row), SKY_LAMP], eye=(0, -0.02, 4), fov_deg=30)
    np.testing.assert_array_equal(_traced(scene), _traced(plain))


@pytest.mark.parametrize("mirrors", [False, True])
def test_in_a_furnace_a_textured_floor_shows_its_albedo(mirrors: bool) -> None:
    """Light of 1 from everywhere: a flat Lambert surface shows its texture, and a white map of
    mirrors whatever their roughness shows 1."""
    map_ = noise_map(7, 1, 0.3, 0.9) if mirrors else noise_map(6, 3, 0.1, 1)
    parts = [textured_floor(material(specular=float(mirrors))), furnace()]
    scene = textured(parts, (map_,), [-1, -1, 0] if mirrors else [0, -1, -1])
    hits = first_hits(scene, resolution=16)
    tracer = load_tracer(scene, max_depth=2, rr_depth=5)
    shown = tracer.radiance(camera_of(scene, 16), seed=1, spp=256)[hits.met]
    if mirrors:
        # The table of multiple scattering is exact to 0.25 % between its entries; the rest is noise
        # of 256 samples, each of which weighs close to 1.
        assert np.abs(shown.mean() - 1) < 0.004
        return
    middle = texture_values(map_, hits.uv[hits.met])
    # A pixel of a flat Lambert surface shows the mean of its texels: differences of both signs.
    assert np.abs(shown.mean(axis=0) - middle.mean(axis=0)).max() < 0.01
    assert np.corrcoef(shown.ravel(), middle.ravel())[0, 1] > 0.99


def _alone(texels: NDArray, **more: Any) -> Scene:
    """Return a floor alone in the picture, under a diffuse texture."""
    parts = [textured_floor(material(diffuse=0.5)), SKY_LAMP]
    return textured(parts, (Texture(texels=texels, **more),), [0, -1, -1], fov=24)


def test_the_longest_texture_is_looked_up_as_the_records_do() -> None:
    """A ramp of 16,384 texels, whose neighbours differ by 1/16384: float32 places lose no texel."""
    ramp = np.linspace(0, 1, MAX_SIDE, dtype=np.float32)
    for upright in (ramp[:, None, None], ramp[None, :, None]):
        scene = _alone(np.ascontiguousarray(np.repeat(upright, 3, axis=-1)))
        tracer = load_tracer(scene, max_depth=3, rr_depth=2)
        found = tracer.features(camera_of(scene, 16), spp=4).albedo.mean(axis=(0, 1))
        pixels = first_hits(scene, resolution=32).material[..., :3]
        np.testing.assert_allclose(found, pixels.mean(axis=(0, 1)), atol=2e-3)


def test_memory_for_texels_is_what_is_stated() -> None:
    """16 bytes a colour and no more: they are decoded in blocks, not as a whole in doubles."""
    texels = np.random.default_rng(0).integers(0, 200, (64, MAX_SIDE, 3), np.uint8)
    scene = _alone(texels, is_srgb=True)
    tracemalloc.start()
    try:
        KernelTextures(scene, np.arange(scene.num_triangles))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1.2 * 16 * 64 * MAX_SIDE


def test_maps_that_break_a_law_never_reach_a_kernel() -> None:
    """Whatever opens or renders a scene checks it first; a child of the renderer trusts that."""
    plain = _alone(np.full((2, 4, 3), 0.5, np.float32))
    for value in (np.nan, np.inf, -1.0):
        texels = np.full((2, 4, 3), 0.5, np.float32)
        texels[1, 2, 0] = value
        wrong = dataclasses.replace(plain, textures=(Texture(texels=texels),))
        below = dataclasses.replace(plain, environment=Environment(radiance_rgb=texels))
        for scene, name in ((below, "environment.radiance_rgb"), (wrong, "textures")):
            with pytest.raises(TrilightError, match=name):
                render(scene, resolution=16, max_spp=8)


def _tracer(scene: Scene) -> VectorTracer:
    return load_tracer(scene, max_depth=10, rr_depth=5)


def test_no_share_of_picks_changes_what_is_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Camera paths, light paths and picks are weighed against each other by the share."""
    scene = open_scene(smooth())
    usual = render_passes(_tracer(scene), scene, passes=8)
    for share in (0.03, 0.97):
        monkeypatch.setattr(kernel_scene, "sky_share", lambda *_, share=share: share)
        other = render_passes(_tracer(scene), scene, first_seed=500, passes=8)
        assert_same_light(other, usual, name=f"share {share}")


def test_a_lamp_alone_has_no_sky() -> None:
    with_sky, without = (open_scene(sky) for sky in (constant(3.0), None))
    row = len(with_sky.objects) - 1
    camera = camera_of(without, 16)
    below_sky, alone = (
        load_tracer(scene, max_depth=5, rr_depth=5).only_light(row).radiance(camera, seed=2, spp=16)
        for scene in (with_sky, without)
    )
    np.testing.assert_array_equal(below_sky, alone)


def test_the_sky_alone_and_each_lamp_add_up_to_all_light() -> None:
    """The same integral, by other samples; a sky that is seen is seen in its own picture alone."""
    scene = open_scene(dataclasses.replace(smooth(), is_seen=True))
    tracer = _tracer(scene)
    *lamps, sky = (
        render_passes(tracer.only_light(row), scene, first_seed=500, passes=8)
        for row in light_sources(scene)
    )
    every = render_passes(tracer, scene, passes=8)
    assert_same_light(np.sum([*lamps, sky], axis=0), every, name="sum")
    with pytest.raises(AssertionError, match="without"):
        assert_same_light(sky, every, name="without lamps")
    nothing = (every.min(axis=0) > 0).all(axis=-1) & ~np.any(lamps, axis=(0, 1, 4))
    assert nothing.any(), "the sky is seen where no lamp lights anything"
    np.testing.assert_array_equal(nothing & tracer.hits(camera_of(scene, 32)), False)


def _turned(seed: int) -> np.ndarray:
    return uniform_rotation(np.random.default_rng(seed)).astype(np.float32)


MAPS = [
    smooth(rotation=_turned(1)),
    one_sun(rotation=_turned(2)),
    six_poles(rotation=_turned(3)),
    as_sky(np.random.default_rng(0).random((1, 2, 3))),
    as_sky(np.random.default_rng(1).random((3, 6, 3)) ** 8, rotation=_turned(4)),
]


def test_radiance_is_that_of_the_definition() -> None:
    for number, sky in enumerate(MAPS):
        directions = np.random.default_rng(number).normal(size=(20_000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        level = sky.rotation.T[:2]  # the seam is among them; at the poles u goes by rounding
        directions = np.concatenate([directions, level, -level])
        table = SkyTable(sky, 1.0)
        found, _ = table.radiance_and_density(mi.Vector3f(directions.T), mi.Bool(True))
        # float32 angles are off by 3e-7 radians, which is 6e-6 texels of 128 across, of the
        # greatest difference between texels.
        error = np.abs(np.array(found).T - environment_values(sky, directions)).max()
        assert error < 2e-5 * sky.radiance_rgb.max() + 1e-6, number


@pytest.mark.parametrize("number", range(len(MAPS)))
def test_directions_come_with_the_density_that_is_stated(number: int) -> None:
    """The mean of L / density over drawn directions is the flux of the map, and so by octants."""
    sky, count = MAPS[number], 1 << 15
    table, rng = SkyTable(sky, 0.7), np.random.default_rng(5)
    u = mi.Point2f(rng.random((2, count)).astype(np.float32))
    direction, pdf, radiance = table.sample(u, mi.Bool(True))
    directions = np.array(direction).T
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-6
    again = table.radiance_and_density(direction, mi.Bool(True))[1]
    np.testing.assert_array_equal(np.array(again), np.array(pdf))
    weighed = np.array(radiance).T / (np.array(pdf)[:, None] / np.float32(0.7))
    octant = (directions > 0) @ np.array([1, 2, 4])
    uniform = rng.normal(size=(1 << 16, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    flux = environment_values(sky, uniform) * 4 * np.pi
    place = (uniform > 0) @ np.array([1, 2, 4])
    for part in range(8):
        ours, theirs = weighed * (octant == part)[:, None], flux * (place == part)[:, None]
        error = np.hypot(*(v.std(axis=0) / np.sqrt(len(v)) for v in (ours, theirs)))
        # Five standard errors of both; octants without light agree exactly but for roundings.
        assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 5 * error + 1e-6).all(), part


def test_a_sun_of_one_texel_is_drawn_by_what_its_neighbours_have_of_it() -> None:
    """Estimates of its flux by one draw differ by the slope within texels, not by 10,000 times."""
    sky = one_sun()
    table, rng = SkyTable(sky, 1.0), np.random.default_rng(6)
    u = mi.Point2f(rng.random((2, 1 << 16)).astype(np.float32))
    _, pdf, radiance = table.sample(u, mi.Bool(True))
    weighed = np.array(radiance)[0] / np.array(pdf)
    # A tent that is drawn by its means over texels: measured 1.05.
    assert weighed.std() < 1.2 * weighed.mean()


def test_alias_tables_have_the_shares_of_their_weights() -> None:
    """Those of rows that are worked off at once, and that of the emitters."""
    rng = np.random.default_rng(7)
    weights = np.concatenate([rng.random((5, 37)) ** 6, np.ones((1, 37)), np.zeros((1, 37))])
    weights[0, 3:] = 0
    weights[1, 5] = 1e6
    expected = np.ones_like(weights)
    expected[:-1] = 37 * weights[:-1] / weights[:-1].sum(axis=1, keepdims=True)
    tables = [alias_table(row / 37) for row in expected]
    for keep, alias in (
        alias_rows(weights),
        [np.array(part) for part in zip(*tables, strict=True)],
    ):
        share = keep.copy()
        for row in range(len(weights)):
            np.add.at(share[row], alias[row], 1 - keep[row])
        # Sums of 37 numbers in double precision.
        np.testing.assert_allclose(share, expected, atol=1e-12)
        assert ((keep >= 0) & (keep <= 1)).all()


def test_the_share_goes_by_peaks_and_is_a_lamps_at_least() -> None:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamps = [
        light([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0]], 20.0),
        light([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0], [0.0, 2.0, 2.0]], 1.0),
    ]
    scene = join([floor, *lamps])
    power = 0.005 * 20 + 0.5 * 1.0
    for flat in (constant(0.05), constant(30.0)):
        assert sky_share(scene, flat) == pytest.approx(1 / 3)  # one of three
    sun = one_sun()
    assert row_solid_angles(64).sum() * 128 == pytest.approx(4 * np.pi)
    excess = row_solid_angles(64)[16] / (4 * np.pi) * (1e5 * (1 + 0.9 + 0.7) / 3 - 0.2)
    assert peaked_radiance(sun) == pytest.approx(excess, rel=1e-6)
    weight = 2 * np.pi * 2.0 * excess  # half of the floor's diagonal is the root of 2
    assert sky_share(scene, sun) == pytest.approx(weight / (weight + power), rel=1e-6)
    assert sky_share(join([floor], sky=sun), sun) == 1
    assert peaked_radiance(night()) > 0


def test_a_flat_map_is_none_in_every_bit_and_flat_texels_change_nothing() -> None:
    row = material(diffuse=[0.2, 0.4, 0.3], specular=0.4, roughness=0.3)
    parts = [textured_floor(row), sphere([0.1, 0, 0.4], 0.3, row, 6), SKY_LAMP]
    flat = np.tile(np.array(FLAT, np.float32), (8, 8, 1))
    edge = flat.copy()
    edge[:, 0] = 0.9, 0.5, 0.8  # where nothing lies
    plain = join(parts, eye=(0, -0.02, 4), fov_deg=30)
    np.testing.assert_array_equal(_traced(mapped(parts, Texture(texels=flat))), _traced(plain))
    away = mapped(parts, Texture(texels=edge), 0.2 * np.eye(2))
    assert away.uv is not None and away.material_textures is not None
    colours = away.material_textures.copy()
    colours[0, 0] = 1
    bumpy = dataclasses.replace(
        away,
        uv=away.uv + np.float32(0.5),
        textures=(*away.textures, noise_map(1, 3, 0.1, 0.5)),
        material_textures=colours,
    )
    smooth = dataclasses.replace(bumpy, normal_textures=None)
    assert np.abs(_traced(bumpy) - _traced(smooth)).max() < 1e-6


def _traced(scene: Scene) -> NDArray[np.float32]:
    tracer = load_tracer(scene, max_depth=5, rr_depth=3)
    return tracer.radiance(camera_of(scene, 16), seed=3, spp=16)


@pytest.mark.parametrize("turned", [False, True])
def test_a_slope_reflects_what_a_tilted_plane_does(turned: bool) -> None:
    """By Lambert's formula, above the horizons of both; u and v may go anywhere on the floor."""
    slope = np.array([0.5, -0.3, 0.0])
    slope[2] = np.sqrt(1 - slope @ slope)
    lamp = np.array([[1.0, -1.5, 3.0], [1.6, -1.5, 3.0], [1.2, -1.0, 3.2]])
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]]) if turned else None  # u grows with y, v against x
    texture = Texture(texels=((slope + 1) / 2).astype(np.float32)[None, None])
    floor = textured_floor(material(diffuse=[0.6, 0.5, 0.4]))
    scene = mapped([floor, light(lamp, 30.0)], texture, turn)
    normal = np.array([-slope[1], slope[0], slope[2]]) if turned else slope
    hits = first_hits(scene, resolution=16)
    assert np.allclose(hits.shading_normal[hits.met], normal, atol=1e-6)
    tracer = load_tracer(scene, max_depth=2, rr_depth=5)
    shown = tracer.radiance(camera_of(scene, 16), seed=1, spp=256)
    points = hits.position[hits.met]
    wanted = lambert_irradiance(points, normal, lamp, 30.0)[:, None] * [0.6, 0.5, 0.4] / np.pi
    error = (shown[hits.met] / wanted - 1).mean(axis=0)
    assert np.abs(error).max() < 0.005, error


@pytest.mark.parametrize("columns", [{"diffuse": 1.0}, {"specular": 1.0, "roughness": 0.3}])
def test_a_white_furnace_gets_no_brighter_and_nothing_black(columns: dict[str, float]) -> None:
    """A lobe around a normal t off loses what lies below the floor: diffuse (1 + cos t) / 2."""
    map_ = bumps(3, 3.0)
    scene = mapped([textured_floor(material(**columns)), furnace()], map_)
    tracer = load_tracer(scene, max_depth=6, rr_depth=5)
    beside = join([textured_floor(material()), SKY_LAMP], eye=(0.3, -3.0, 0.7), fov_deg=30)
    camera = dataclasses.replace(camera_of(scene, 16), c2w=beside.c2w[0].astype(np.float64))
    shown = tracer.radiance(camera, seed=1, spp=256)[tracer.hits(camera)]
    assert np.isfinite(shown).all()
    assert shown.max() < 1 + 1e-3 if "diffuse" in columns else shown.max() < 1.05
    assert shown.min() > (0.25 if "diffuse" in columns else 0.15)  # half of it at the rim
    if "diffuse" in columns:
        above = camera_of(scene, 16)
        seen = tracer.radiance(above, seed=1, spp=256)[2:-2, 2:-2]
        cosine = first_hits(scene, resolution=64).shading_normal[8:-8, 8:-8, 2]
        assert abs(seen.mean() - np.mean((1 + cosine) / 2)) < 0.01


def test_guides_and_passes_are_the_definition_and_turn_with_the_scene() -> None:
    """On a ball, mirrored coordinates and all; where u has no direction, the normal stays."""
    row = material(diffuse=0.5, roughness=0.5)
    for turn in (None, np.diag([-1.0, 1.0]), np.zeros((2, 2))):
        scene = mapped([sphere([0, 0, 0], 0.8, row, 9), SKY_LAMP], bumps(5, 1.0), turn)
        guide = _guides(scene).normal
        hits = first_hits(scene, resolution=32)
        off = np.linalg.norm(np.nan_to_num(hits.shading_normal) - guide, axis=-1)
        assert np.mean(off > 1e-3) < 0.02  # texels' borders, and the ball's
        kept = view_passes(scene, ["shading_normal"], resolution=32)["shading_normal"]
        assert np.array_equal(kept, hits.shading_normal, equal_nan=True)
        smooth = dataclasses.replace(scene, normal_textures=None)
        bent = np.nan_to_num(first_hits(smooth, resolution=32).shading_normal) - guide
        assert (np.abs(bent).max() > 0.3) == (turn is None or turn.any())
        rotation = uniform_rotation(np.random.default_rng(1))
        there = first_hits(moved(scene, rotation, [0.3, -0.2, 0.1]), resolution=32)
        back = np.nan_to_num(there.shading_normal) @ rotation
        assert np.mean(np.linalg.norm(back - guide, axis=-1) > 1e-3) < 0.03


def test_frames_without_a_direction_and_odd_texels_leave_unit_normals() -> None:
    up = np.array([[0.0, 0, 1]] * 5)
    directions = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0]])
    texels = np.array([[1, 0.5, 0.5], [1, 1, 1], [1, 1, 1], [0.5, 0.5, 0.5], [0.5, 0.5, 0.0]])
    found = mapped_normals(up, directions, texels)
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert np.array_equal(found[1:], up[1:])
    assert np.allclose(found[0], [1, 0, LEAST_Z], atol=1e-4)
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 4, np.float64)
    uv = np.array(
        [
            [[0, 0], [1, 0], [0, 1]],
            [[0, 0], [-1, 0], [0, 1]],
            [[0, 0]] * 3,
            [[0, 0], [1, 1], [2, 2]],
        ],
        np.float64,
    )
    wanted = [[1, 0, 0], [-1, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert np.allclose(u_directions(corners, uv), wanted)
    assert np.array_equal(u_directions(np.full_like(corners, np.nan), uv), np.zeros((4, 3)))
