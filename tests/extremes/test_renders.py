"""Far from the defaults, a picture is finite and non-negative, or rejected with a reason."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import Rejected
from storage.records.exr import decode_exr, encode_exr
from storage.records.parts import sum_of_parts
from storage.records.scene import Scene
from tests.extremes.range_examples import naming
from tests.pipeline.renders.scene_kit import (
    Part,
    flat,
    furnace,
    join,
    light,
    material,
    quad,
    sphere,
)

SETTINGS = RenderSettings(
    resolution=16, noise_floor_db=1.0, min_spp=32, max_spp=32, aux_spp=16, min_mean_radiance=0.0
)
FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
LAMP = [[-0.1, -0.1, 2], [0, 0.1, 2], [0.1, -0.1, 2]]


def _floor(surface: NDArray[np.float64] | None = None, scale: float = 1.0) -> Part:
    row = material(diffuse=0.5) if surface is None else surface
    return quad(np.array(FLOOR) * scale, row)


def _lamp(radiance: float = 100.0, scale: float = 1.0, diffuse: float = 0.0) -> Part:
    return light(np.array(LAMP) * scale, radiance, diffuse)


def _render(scene: Scene, settings: RenderSettings = SETTINGS) -> RenderedView:
    scene.check()
    renderer = SceneRenderer(scene, settings)
    return renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), seed=0)


def _sliver(aspect: float) -> Part:
    return flat([[[-0.5, 0, 0.5], [0.5, 0, 0.5], [0, aspect, 0.5]]], material(diffuse=0.5))


def _mirror(side: float = 1.0) -> Part:
    """A smooth wall beside the floor: it throws light of the lamp on it."""
    corners = np.array([[1, -1, 0], [1, 1, 0], [1, 1, 2], [1, -1, 2]]) * [side, 1, 1]
    return quad(corners, material(specular=1.0, roughness=0.0))


SURFACES = {
    "black": material(),
    "white diffuse": material(diffuse=1.0),
    "perfect mirror": material(specular=1.0, roughness=0.0),
    "rough metal": material(specular=1.0, roughness=1.0),
    "sum of exactly one": material(diffuse=0.25, specular=0.75, roughness=0.3),
    "one channel each": material(diffuse=[1, 0, 0], specular=[0, 1, 0], roughness=0.0),
}
SHAPES = {
    "one triangle": [flat([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], material(diffuse=0.5)), _lamp()],
    "sliver 1e-3": [_sliver(1e-3), _floor(), _lamp()],
    "sliver 1e-7": [_sliver(1e-7), _floor(), _lamp()],
    "coincident floors": [_floor(), _floor(material(specular=0.9, roughness=0.1)), _lamp()],
    "interpenetrating": [sphere([0, 0, 0], 0.5, material(diffuse=0.9)), _floor(), _lamp()],
    "light on the floor": [  # which it does not light: only what stands above it
        _floor(), light(np.array(LAMP) * [1, 1, 0], 100.0),
        sphere([0.5, 0, 0.5], 0.3, material(diffuse=0.9)),
    ],
    "light inside an object": [
        sphere([0, 0, 2], 0.5, material(diffuse=0.9)), _floor(), _lamp(),
        light(np.add(LAMP, [0, 0, 1]), 1.0),
    ],
    "faint light": [_floor(), _lamp(1e-3)],
    "white lights face to face": [_floor(), _lamp(diffuse=1.0), _lamp(scale=1.001, diffuse=1.0)],
    "64 lights": [_floor(), *[_lamp(1.0 + i, 1 + 0.01 * i) for i in range(64)]],
    "caustic of a mirror": [_floor(), _mirror(), _lamp()],
    "caustic of a tiny light": [_floor(), _mirror(), light(np.array(LAMP) * [1e-3, 1e-3, 1], 1e6)],
    "a light between two mirrors": [_floor(), _mirror(), _mirror(-1), _lamp()],
    "a light far away": [_floor(), _mirror(), light(np.add(LAMP, [0, 0, 998]), 1e7)],
    "light of a millimetre": [_floor(), light(np.array(LAMP) * [1e-3, 1e-3, 1], 1e6)],
}  # fmt: skip


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES.keys())
def test_extreme_materials(surface: NDArray[np.float64]) -> None:
    """Whole, and by part: a share is a quotient of what may be 0 or large.

    What a lobe lacks is exactly black.
    """
    ball = sphere([0, 0, 0.5], 0.5, surface)
    picture = _render(join([ball, _floor(surface), _lamp()])).radiance_rgb
    assert np.isfinite(picture).all()
    assert (picture >= 0).all()
    scene = join([ball, _floor(surface), _mirror(), _lamp()])
    view = _render(scene, dataclasses.replace(SETTINGS, split=True, split_lobes=True))
    assert view.parts_rgb is not None
    np.testing.assert_array_equal(sum_of_parts(view.parts_rgb), view.radiance_rgb)
    for name, part in view.parts_rgb.items():
        assert np.isfinite(part).all() and (part >= 0).all()
        if "diffuse" in name and not surface[:3].any():
            assert not part.any()


@pytest.mark.parametrize("roughness", [0.0, 0.01, 1.0])
def test_extreme_materials_at_grazing_angles(roughness: float) -> None:
    """The scale for multiple scattering is 0 / 0 along the surface, and largest at roughness 1."""
    low = light(np.array(LAMP) * [1, 1, 0] + [0, 0.9, 1e-3], 100.0)
    for specular, height in (
        ([1.0, 1.0, 1.0], 1e-3),
        ([0.0, 0.0, 0.0], 1e-3),
        ([1.0, 0.5, 0.0], 1e-3),
        ([1.0, 1.0, 1.0], 1e-2),
    ):
        surface = material(specular=specular, roughness=roughness)
        scene = join([_floor(surface), low, _lamp()], eye=(0, -0.9, height), target=(0, 0.5, 0))
        picture = _render(scene).radiance_rgb
        assert np.isfinite(picture).all(), (specular, height)
        assert (picture >= 0).all(), (specular, height)
        assert (picture.max() > 0) == (max(specular) > 0), (specular, height)


def test_extreme_shapes_and_lights() -> None:
    for name, parts in SHAPES.items():
        picture = _render(join(parts)).radiance_rgb
        assert np.isfinite(picture).all(), name
        assert (picture >= 0).all(), name
        assert picture.max() > 0, name


def test_extreme_fields_of_view() -> None:
    for fov_deg in (1.0, 10.0, 120.0, 170.0):
        picture = _render(join([_floor(), _lamp()], fov_deg=fov_deg)).radiance_rgb
        assert np.isfinite(picture).all(), fov_deg
        assert picture.max() > 0, fov_deg


@pytest.mark.parametrize("scale", [1e-3, 5e2])
def test_scale_changes_nothing(scale: float) -> None:
    """Radiance knows no length: a scaled scene seen by a scaled camera is the same picture."""

    def picture(s: float) -> NDArray[np.float32]:
        eye = (0.0, -2.0 * s, 0.5 * s)
        return _render(join([_floor(scale=s), _lamp(scale=s)], eye=eye)).radiance_rgb

    # equal random numbers, so that only float32 rounding of positions differs; it turns some
    # samples over at edges, each of which moves a pixel by up to 1/32 of the brightest value
    assert np.median(abs(picture(scale) - picture(1.0))) < 1e-3 * picture(1.0).max()


@pytest.mark.parametrize("radiance", [1e-3, 1e4])
def test_a_white_surface_in_a_furnace_conserves_energy(radiance: float) -> None:
    ball = sphere([0, 0, 0], 0.5, material(diffuse=1.0), rings=24)
    scene = join([ball, furnace(radiance)], eye=(0, -2, 0), fov_deg=10)
    view = _render(scene)
    # every path ends in the furnace, so there is no noise; the cut at 10 edges loses nothing on a
    # convex body; 1 % is what shading normals on the facets of the ball take away
    assert view.radiance_rgb[view.hits].mean() == pytest.approx(radiance, rel=0.01)


def test_the_brightest_picture_survives_the_file() -> None:
    view = _render(join([_floor(material(diffuse=1.0)), _lamp(3e6)]))
    assert 1000 < view.radiance_rgb.max() < HALF_FLOAT_MAX
    back = decode_exr(encode_exr(view.radiance_rgb))
    # half floats round to 2^-11 of the value, and below 6e-5 to steps of 6e-8
    assert np.allclose(back, view.radiance_rgb, rtol=2**-11, atol=6e-8)


def test_a_scene_without_light_is_refused_by_its_laws() -> None:
    with pytest.raises(ValueError, match="no emission"):
        _render(join([_floor()]))


CLOSED = sphere([0, 0, 1], 0.5, material(diffuse=0.9))
AWAY: dict[str, Any] = {"eye": (0, -2, 0.5), "target": (0, -4, 0.5)}
INSIDE: dict[str, Any] = {"eye": (0, 0, 1), "target": (0.3, 0, 1)}
REASONS = {
    "looks away": (join([_floor(), _lamp()], **AWAY), "black_view"),
    "inside a closed object": (join([CLOSED, _floor(), _lamp()], **INSIDE), "black_view"),
    "light in a closed object": (
        join([CLOSED, _floor(), light(np.array(LAMP) * [1, 1, 0.5], 9.0)]), "black_view",
    ),
    "black surfaces": (join([_floor(material()), _lamp()]), "black_view"),
    "too faint": (join([_floor(), _lamp(1e-3)]), "black_view"),
    "emitters alone": (join([_lamp(), _lamp(1.0, 1.1)]), "no_surfaces"),
    "brighter than float32": (
        join([_floor(), light(np.array(LAMP) * [90, 90, 1], 3e38)]), "nonfinite_radiance",
    ),
    "beyond the denoiser": (
        join([_floor(), light(np.array(LAMP) * [9, 9, 1], 3e38)]), "radiance_overflow",
    ),
    "brighter than halves": (join([_floor(), _lamp(1e9)]), "radiance_overflow"),
}  # fmt: skip


def test_what_cannot_be_rendered_has_a_reason() -> None:
    """With the bound on darkness that builds have; and each is rejected again for the same."""
    settings = dataclasses.replace(SETTINGS, min_mean_radiance=0.01)
    for name, (scene, reason) in REASONS.items():
        messages = []
        for _ in range(2):
            with naming(name), pytest.raises(Rejected, match=reason) as caught:
                SceneRenderer(scene, settings).render_view(scene.c2w[0], 40.0, seed=0)
            messages.append(str(caught.value))
        assert messages[0] == messages[1], name


def test_an_emitter_without_area_leaves_a_scene_unlit() -> None:
    scene = join([_floor(), _lamp()])
    scene.vertex_positions[-3:] = [[0.0, 0, 2], [0.1, 0, 2], [0.2, 0, 2]]
    with pytest.raises(Rejected, match="unlit_scene"):
        SceneRenderer(scene, SETTINGS)


def test_a_camera_in_a_lit_room_or_object_is_a_picture() -> None:
    inside = join([CLOSED, light(np.array(LAMP) * 0.3 + [0, 0, 0.6], 5.0)], **INSIDE)
    picture = _render(inside).radiance_rgb
    assert np.isfinite(picture).all()
    assert picture.min() > 0


def test_a_camera_on_a_face_a_vertex_or_an_emitter() -> None:
    for eye in ((0, 0, 0), (-1, -1, 0), (0, 0.1, 2)):
        scene = join([_floor(), _lamp()], eye=eye, target=(0.5, 0.4, -0.2))
        assert np.isfinite(_render(scene).radiance_rgb).all(), eye


WIDE_VIEW = join([_floor(), light(np.array(LAMP) * [9, 9, 1], 5.0)], fov_deg=60)


@pytest.fixture(scope="module")
def truth() -> NDArray[np.float32]:
    """Return the wide view in 8 x 8 pixels, nearly converged."""
    exact = dataclasses.replace(SETTINGS, resolution=8, min_spp=4096, max_spp=4096, denoiser="off")
    return SceneRenderer(WIDE_VIEW, exact).render_view(WIDE_VIEW.c2w[0], 60.0, seed=1).radiance_rgb


@pytest.mark.parametrize(("resolution", "spp"), [(8, 1024), (40, 128), (136, 16)])
def test_any_multiple_of_eight_is_a_resolution(
    resolution: int, spp: int, truth: NDArray[np.float32]
) -> None:
    """8 is the least, 40 no power of two, 136 wider than 128; all show the same."""
    settings = dataclasses.replace(SETTINGS, resolution=resolution, min_spp=spp, max_spp=spp)
    view = SceneRenderer(WIDE_VIEW, settings).render_view(WIDE_VIEW.c2w[0], 60.0, seed=0)
    assert view.radiance_rgb.shape == (resolution, resolution, 3)
    assert view.hits.shape == (resolution, resolution)
    block = resolution // 8
    shown = view.radiance_rgb.reshape(8, block, 8, block, 3).mean(axis=(1, 3))
    lit = truth > 0.05 * truth.max()
    # Measured: 0.065 at 8 pixels, where the denoiser smears a picture of nothing but edges; at the
    # others every 1/64 of a picture holds 3,200 samples or more, which leave 2 % of noise. A
    # picture upside down or a row off compares the floor with the black behind it.
    assert np.median(abs(shown - truth)[lit] / truth[lit]) < (0.1 if resolution == 8 else 0.05)
    assert decode_exr(encode_exr(view.radiance_rgb)).shape == view.radiance_rgb.shape
