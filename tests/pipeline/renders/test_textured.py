"""Textured pictures: the lookup of the records, the right corners, and stock Mitsuba's bitmaps."""

import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from storage.records.first_hits import first_hits
from storage.records.lookup import texture_values
from storage.records.retextured import with_textures
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.oracle.kernel_bsdf import exact_twin
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import (
    Estimate,
    assert_agree,
    camera_of,
    render_blocks,
)
from tests.pipeline.renders.scene_kit import (
    Part,
    furnace,
    join,
    light,
    material,
    quad,
    sphere,
)

pytestmark = pytest.mark.usefixtures("llvm")

RED, GREEN, BLUE, YELLOW = (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8), (0.7, 0.7, 0.1)
CORNERS = Texture(texels=np.array([[RED, GREEN], [BLUE, YELLOW]], np.float32))
"""Row 0 is the bottom: red at the lower left, green right of it, blue above red."""


def _floor(row: NDArray[np.float64]) -> Part:
    return quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], row)


def _textured(
    parts: list[Part], textures: tuple[Texture, ...], of_floor: list[int], scale: float = 1.0
) -> Scene:
    """Return parts, of which the first is textured; u and v go with x and y: 0 to 1 over it."""
    scene = join(parts, eye=(0, -0.02, 4), fov_deg=30)
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
    score = _scores(ours, theirs)
    # As in test_twin_tracers: honest errors of 16 passes give 1.04 and a mean of about 0.
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.3
    assert len(score) > 90 and abs(score.mean()) < 0.35
    plain = render_blocks(_with_means(scene), passes=4)
    assert np.abs(_scores(ours, plain)).max() > 20  # the test sees textures


def _with_means(scene: Scene) -> Scene:
    return dataclasses.replace(scene, uv=None, textures=(), material_textures=None)


def _scores(ours: Estimate, theirs: Estimate) -> NDArray[np.float64]:
    lit = ours.mean > 0.01 * ours.mean.max()
    return (ours.mean - theirs.mean)[lit] / np.hypot(ours.error, theirs.error)[lit]


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
