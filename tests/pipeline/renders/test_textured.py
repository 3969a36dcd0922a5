"""Textured pictures: lookups, corners, stock Mitsuba's bitmaps, and maps at the edges of law."""

import dataclasses
import hashlib
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.kernel_textures import KernelTextures
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.pieces import apply_skin, concatenate_pieces, emitter_piece, object_piece
from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.source_materials import source_skins
from scene_templates.layout import Emitter
from scene_templates.materials import MaterialSettings
from storage.conventions import look_at_c2w
from storage.errors import Rejected, TrilightError
from storage.records.environment import Environment
from storage.records.first_hits import first_hits
from storage.records.lookup import texture_values
from storage.records.retextured import with_textures, without_constant_textures
from storage.records.scene import Scene, SceneObject
from storage.records.texture import MAX_SIDE, Texture
from storage.seeds import SceneKey
from tests.oracle.kernel_bsdf import exact_twin
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.assets.meshes_by_hand import prepare
from tests.pipeline.assets.source_materials.textured_kit import (
    CORNERS as PICTURE_CORNERS,
)
from tests.pipeline.assets.source_materials.textured_kit import (
    KEEP,
    QUARTERS,
    picture_bytes,
    textured_glb,
    textured_obj,
)
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_honest,
    camera_of,
    render_blocks,
    render_view,
    scores,
)
from tests.pipeline.renders.scene_kit import Part, furnace, join, light, material, quad, sphere
from tests.pipeline.scenes.small_pool import LOOK, small_pool
from tests.sky_maps import constant, one_sun
from trilight import render

pytestmark = pytest.mark.usefixtures("llvm")


RED, GREEN, BLUE, YELLOW = (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8), (0.7, 0.7, 0.1)
CORNERS = Texture(texels=np.array([[RED, GREEN], [BLUE, YELLOW]], np.float32))
"""Row 0 is the bottom: red at the lower left, green right of it, blue above red."""


def _floor(row: NDArray[np.float64]) -> Part:
    return quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], row)


def _textured(
    parts: list[Part],
    textures: tuple[Texture, ...],
    of_floor: list[int],
    scale: float = 1.0,
    fov: float = 30,
) -> Scene:
    """Return parts, of which the first is textured; u and v go with x and y: 0 to 1 over it."""
    scene = join(parts, eye=(0, -0.02, 4), fov_deg=fov)
    index = np.full((len(parts), 3), -1, np.int32)
    index[0] = of_floor
    xy = scene.vertex_positions[scene.faces.ravel(), :2]
    uv = (scale * (xy + 1) / 2).astype(np.float32)
    textured = with_textures(scene, uv, textures, index)
    textured.check()
    return textured


def _noise(seed: int, channels: int, low: float, high: float) -> Texture:
    drawn = np.random.default_rng(seed).uniform(low, high, (5, 7, channels))
    return Texture(texels=drawn.astype(np.float32))


LAMP = light(np.array([[-1, -1, 3], [2, -1, 3], [0, 1, 2.5]]), 5.0)
TRACERS = [load_tracer, pytest.param(PluginTracer, marks=pytest.mark.slow("statistics"))]


def test_corners_have_their_colours() -> None:
    """Seen from above with +x to the right and +y up; a turn or a mirrored u would swap them."""
    scene = _textured([_floor(material(diffuse=0.5)), LAMP], (CORNERS,), [0, -1, -1])
    tracer = load_tracer(scene, max_depth=2, rr_depth=5)
    albedo = tracer.features(camera_of(scene, 32), spp=1).albedo
    quarters = {(24, 8): RED, (24, 23): GREEN, (8, 8): BLUE, (8, 23): YELLOW}
    for (row, column), colour in quarters.items():
        # The quad fills the picture but for a border: a quarter's middle is about a texel's centre.
        assert np.abs(albedo[row, column] - colour).max() < 0.08


@pytest.mark.parametrize("tracer", TRACERS)
def test_guides_are_the_lookup_of_the_records(tracer: Any) -> None:
    """Coordinates from -1.75 to 1.25 wrap; a diffuse and a specular map of unlike sizes add up."""
    maps = _noise(1, 3, 0, 0.6), CORNERS_OF_LESS
    scene = _textured([_floor(material(roughness=0.4)), LAMP], maps, [0, 1, -1])
    scene = _moved(scene, 3.0, np.array([-1.75, -1.75]))
    made = tracer(scene, max_depth=2, rr_depth=5)
    albedo = made.features(camera_of(scene, 32), spp=1).albedo
    rows = np.nan_to_num(first_hits(scene, resolution=32).material)
    wanted = rows[..., 0:3] + rows[..., 3:6]
    # Float32 places of hits: 1e-6 of a coordinate is 7e-6 texels, whose values differ by up to .6.
    # Single pixels at the border of the quad may be met by one and missed by the other.
    assert np.mean(np.abs(albedo - wanted).max(axis=-1) > 2e-5) < 0.01
    assert np.ptp(wanted, axis=(0, 1)).min() > 0.5


CORNERS_OF_LESS = Texture(texels=(0.3 * CORNERS.texels).astype(np.float32))


def _moved(scene: Scene, scale: float, shift: NDArray[np.float64]) -> Scene:
    assert scene.uv is not None
    return dataclasses.replace(scene, uv=(scale * scene.uv + shift).astype(np.float32))


def test_far_coordinates_lose_no_digits() -> None:
    scene = _textured([_floor(material()), LAMP], (_noise(2, 3, 0, 1),), [0, -1, -1])
    far = _moved(scene, 1.0, np.array([1000.0, -512.0]))
    camera = camera_of(scene, 16)
    near, moved = (
        load_tracer(each, max_depth=2, rr_depth=5).features(camera, spp=1).albedo
        for each in (scene, far)
    )
    # The stored coordinates know 1000 to 3e-5: two ten-thousandths of a texel.
    assert np.abs(near - moved).max() < 5e-4


def test_a_constant_texture_is_its_constant_in_every_bit() -> None:
    row = material(diffuse=[0.2, 0.4, 0.6], specular=0.3, roughness=0.25)
    one = Texture(texels=np.full((4, 4, 3), np.array([0.2, 0.4, 0.6]), np.float32))
    scene = _textured([_floor(row), LAMP], (one,), [0, -1, -1])
    plain = join([_floor(row), LAMP], eye=(0, -0.02, 4), fov_deg=30)
    digests = {
        hashlib.sha256(
            load_tracer(each, max_depth=5, rr_depth=3)
            .radiance(camera_of(each, 16), seed=3, spp=16)
            .tobytes()
        ).hexdigest()
        for each in (scene, plain)
    }
    assert len(digests) == 1


_MAPS = {
    "diffuse": ((_noise(3, 3, 0, 0.95),), [0, -1, -1], material(specular=0.05, roughness=0.5)),
    "roughness": ((_noise(4, 1, 0.2, 1),), [-1, -1, 0], material(diffuse=0.1, specular=0.8)),
    "specular": ((_noise(5, 3, 0, 0.9),), [-1, 0, -1], material(diffuse=0.1, roughness=0.4)),
}


@pytest.mark.slow("statistics")
@pytest.mark.parametrize("name", list(_MAPS))
def test_pictures_agree_with_stock_bitmaps_within_noise(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ball on a textured floor, with light paths and bounces, against Mitsuba's integrator."""
    textures, index, row = _MAPS[name]
    ball = sphere([0.2, 0.1, 0.4], 0.4, material(diffuse=0.2, specular=0.7, roughness=0.3), 8)
    scene = _textured([_floor(row), ball, LAMP], textures, index, scale=2.0)
    ours = render_blocks(scene)
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=5)
    theirs = render_blocks(scene, first_seed=500, tracer=twin)
    assert_agree(ours, theirs, slack=1e-3)  # the twins of an emitter stand 1e-4 off
    assert_honest(ours, theirs)
    plain = render_blocks(_with_means(scene), passes=4)
    assert np.abs(scores(ours, plain)).max() > 20  # the test sees textures


def _with_means(scene: Scene) -> Scene:
    return dataclasses.replace(scene, uv=None, textures=(), material_textures=None)


@pytest.mark.parametrize("mirrors", [False, True])
def test_in_a_furnace_a_textured_floor_shows_its_albedo(mirrors: bool) -> None:
    """Light of 1 from everywhere: a flat Lambert surface shows its texture, and a white map of
    mirrors whatever their roughness shows 1."""
    map_ = _noise(6, 3, 0.1, 1)
    if mirrors:
        roughness = _noise(7, 1, 0.3, 0.9)
        parts = [_floor(material(specular=1.0)), furnace()]
        scene = _textured(parts, (roughness,), [-1, -1, 0])
    else:
        scene = _textured([_floor(material()), furnace()], (map_,), [0, -1, -1])
    tracer = load_tracer(scene, max_depth=2, rr_depth=5)
    hits = first_hits(scene, resolution=16)
    met = hits.met
    shown = tracer.radiance(camera_of(scene, 16), seed=1, spp=256)
    if mirrors:
        # The table of multiple scattering is exact to 0.25 % between its entries; the rest is noise
        # of 256 samples, each of which weighs close to 1.
        assert np.abs(shown[met].mean() - 1) < 0.004
        return
    middle = texture_values(map_, hits.uv[met])
    # A pixel of a flat Lambert surface shows the mean of its texels: differences of both signs.
    assert np.abs(shown[met].mean(axis=0) - middle.mean(axis=0)).max() < 0.01
    assert np.corrcoef(shown[met].ravel(), middle.ravel())[0, 1] > 0.99


CHEAP = RenderSettings(
    resolution=16, noise_floor_db=20.0, min_spp=32, max_spp=32, min_mean_radiance=0.0,
    denoiser="off",
)  # fmt: skip
FLOOR_CORNERS = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]


def floor_scene(sky: Environment | None, *, mirror: bool = False) -> Scene:
    row = material(specular=0.9, roughness=0.01) if mirror else material(diffuse=0.5)
    return join([quad(FLOOR_CORNERS, row), LAMP], eye=(0, -2.5, 2), fov_deg=40, sky=sky)


def _textured_floor(texture: Texture) -> Scene:
    """Return the floor alone in the picture, under a diffuse texture."""
    return _textured([_floor(material(diffuse=0.5)), LAMP], (texture,), [0, -1, -1], fov=24)


def _shown(scene: Scene) -> RenderedView:
    scene.check()
    return render_view(scene, CHEAP, 1)


def test_a_sun_of_a_million_gives_a_picture_or_says_that_it_is_too_bright() -> None:
    """On a matt floor a few hundred; in a mirror that sees it more than half floats hold."""
    view = _shown(floor_scene(one_sun(1e6)))
    assert np.isfinite(view.radiance_rgb).all() and view.radiance_rgb.max() > 100
    assert np.isfinite(view.noise_floor_db)
    everywhere = constant(1e6)
    with pytest.raises(Rejected, match="radiance_overflow"):
        _shown(floor_scene(everywhere, mirror=True))


def test_a_black_sky_is_no_sky_in_every_bit() -> None:
    without = _shown(floor_scene(None))
    for seen in (False, True):
        black = _shown(floor_scene(constant(0.0, is_seen=seen)))
        np.testing.assert_array_equal(black.radiance_rgb, without.radiance_rgb)


def test_a_sky_of_two_texels() -> None:
    """The smallest lawful one: seen, it is its radiance in each pixel; it lights as a larger one.

    128 pixels of 32 samples with a spread of about 1: the means differ by far less than 5 %.
    """
    tiny, large = (
        _shown(floor_scene(constant([0.2, 0.4, 0.8], height=height, is_seen=True)))
        for height in (1, 32)
    )
    assert not tiny.hits[0].any()
    np.testing.assert_allclose(tiny.radiance_rgb[0], [[0.2, 0.4, 0.8]] * 16, rtol=1e-5)
    means = [view.radiance_rgb[view.hits].mean(axis=0) for view in (tiny, large)]
    np.testing.assert_allclose(means[0], means[1], rtol=0.05)


@pytest.mark.parametrize("upright", [False, True])
def test_the_longest_texture_is_looked_up_as_the_records_do(upright: bool) -> None:
    """A ramp of 16,384 texels, whose neighbours differ by 1/16384: float32 places lose no texel."""
    ramp = np.linspace(0, 1, MAX_SIDE, dtype=np.float32)
    texels = np.repeat(ramp[:, None, None] if upright else ramp[None, :, None], 3, axis=-1)
    scene = _textured_floor(Texture(texels=np.ascontiguousarray(texels)))
    tracer = load_tracer(scene, max_depth=3, rr_depth=2)
    found = tracer.features(camera_of(scene, 16), spp=4).albedo.mean(axis=(0, 1))
    pixels = first_hits(scene, resolution=32).material[..., :3]
    np.testing.assert_allclose(found, pixels.mean(axis=(0, 1)), atol=2e-3)


def test_memory_for_texels_is_what_is_stated() -> None:
    """16 bytes a colour and no more: they are decoded in blocks, not as a whole in doubles."""
    texels = np.random.default_rng(0).integers(0, 200, (64, MAX_SIDE, 3), np.uint8)
    scene = _textured_floor(Texture(texels=texels, is_srgb=True))
    tracemalloc.start()
    try:
        KernelTextures(scene, np.arange(scene.num_triangles))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1.2 * 16 * 64 * MAX_SIDE


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_maps_that_break_a_law_never_reach_a_kernel(value: float) -> None:
    """Whatever opens or renders a scene checks it first; a child of the renderer trusts that."""
    texels = np.full((2, 4, 3), 0.5, np.float32)
    texels[1, 2, 0] = value
    below = dataclasses.replace(floor_scene(None), environment=Environment(radiance_rgb=texels))
    look = np.full((2, 2, 3), 0.25, np.float32)
    look[0, 1, 1] = value
    plain = _textured_floor(Texture(texels=np.full((2, 2, 3), 0.25, np.float32)))
    wrong = dataclasses.replace(plain, textures=(Texture(texels=look),))
    for scene, name in ((below, "environment.radiance_rgb"), (wrong, "textures")):
        with pytest.raises(TrilightError, match=name):
            render(scene, resolution=16, max_spp=8)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_traced_picture_has_the_colours_in_their_corners(tmp_path: Path, kind: str) -> None:
    """From a file to a picture: red at the lower left, as its picture has it."""
    data = picture_bytes(PICTURE_CORNERS)
    path = (
        textured_glb(tmp_path / "a.glb", data)
        if kind == "glb"
        else textured_obj(tmp_path / "o" / "a.obj", data)
    )
    entry = PooledAsset(locked=small_pool()[0].locked, asset=prepare(path, KEEP))
    level = entry.asset.levels[0]
    (skin,) = source_skins([entry], [level], MaterialSettings(source="object"), SceneKey(0, 0))
    assert skin is not None
    positions = level.positions
    square = object_piece(
        SceneObject(name="square", kind="object"),
        positions,
        level.faces,
        LOOK,
        np.random.default_rng(0),
        30.0,
    )
    square = apply_skin(square, positions, level.faces, skin)
    lamp = emitter_piece(
        Emitter(
            triangle=np.array([[-1, -3, 2], [1, -3, 2], [0, -3, 3.0]]),
            radiance_rgb=(9.0, 9.0, 9.0),
            reflectance=0.0,
        ),
        0,
    )
    scene = without_constant_textures(
        Scene(
            **concatenate_pieces([square, lamp]),
            c2w=look_at_c2w(eye=[0, -2, 0], target=[0, 0, 0], up=[0, 0, 1])[None].astype(
                np.float32
            ),
            fov_deg=np.array([30], np.float32),
            objects=(square.entry, lamp.entry),
            provenance={"template": "none"},
        )
    )
    scene.check()
    assert len(scene.textures) == 1  # specular and roughness are constants
    picture = load_tracer(scene, max_depth=2, rr_depth=5).radiance(
        camera_of(scene, 32), spp=64, seed=0
    )
    centre, width = 16, 32 / (2 * 2 * np.tan(np.radians(15)))  # pixels for each metre
    for (right, up), colour in QUARTERS.items():
        row, column = int(centre - up * width), int(centre + right * width)
        seen = picture[row, column]
        lit = np.array(colour) > 0
        assert seen[lit].min() > 4 * seen[~lit].max(initial=0), (right, up, seen)
