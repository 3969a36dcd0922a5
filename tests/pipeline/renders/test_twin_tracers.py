"""Our path tracer against Mitsuba's plugins and closed forms; light that is kept apart."""

import dataclasses
import itertools
import json
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.generation.scene_origins import RenderInput
from pipeline.generation.scene_worker import ViewProgress, render_sample
from pipeline.presets.registry import preset_settings
from pipeline.presets.settings import DatasetSettings
from pipeline.renders import kernel_scene
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.tracer import load_tracer
from pipeline.renders.vector_tracer import VectorTracer
from scene_templates.rotations import uniform_rotation
from storage.conventions import camera_rays
from storage.dataset.manifest import Manifest
from storage.dataset.verify import check_sample
from storage.errors import Rejected
from storage.metrics import MAX_DB, psnr_log_db
from storage.records.exr import decode_exr, encode_exr
from storage.records.lights import (
    MAX_LIGHTS,
    part_names,
    rounded_to_half,
    sum_of_lights,
    sum_of_parts,
)
from storage.records.retextured import NO_TEXTURES
from storage.records.sample import Sample, decode_sample, encode_sample
from storage.records.scene import Scene
from storage.records.texture import Texture
from storage.settings.described import settings_record
from tests.oracle.kernel_bsdf import exact_twin
from tests.pipeline.programs import printed_by
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_honest,
    blocks_of,
    camera_of,
    exact,
    lambert_irradiance,
    render_blocks,
    render_view,
    scores,
    view_settings,
)
from tests.pipeline.renders.scene_kit import (
    SKY_LAMP,
    Part,
    box,
    bumpy_room,
    flat,
    furnace,
    furniture,
    join,
    light,
    mapped,
    material,
    mirrors,
    noise_map,
    open_scene,
    quad,
    sampled_like_scene,
    sphere,
    textured,
    textured_floor,
)
from tests.pipeline.renders.test_renderer import lit_scene
from tests.scenes_by_hand import tiny_scene
from tests.sky_maps import night, one_sun, smooth
from tests.textured_by_hand import bumps

pytestmark = pytest.mark.usefixtures("llvm")


def _room(num_lights: int) -> Scene:
    rng = np.random.default_rng(num_lights)
    parts = furniture()
    for _ in range(num_lights):
        centre = np.array([0.2, -0.9, 0.9]) + rng.uniform(-0.4, 0.4, 3)
        triangle = centre + rng.normal(size=(3, 3)) * rng.uniform(0.1, 0.2)
        parts.append(light(triangle, rng.uniform(1, 20, 3), diffuse=1.0))
    return join(parts, eye=(0.5, -1.7, 0.6), fov_deg=45)


def _textured_room(texture: Texture, index: list[int], **columns: float) -> Callable[[], Scene]:
    """Return what makes a ball on a textured floor, with light paths and bounces."""

    def made() -> Scene:
        row = material(diffuse=0.2, specular=0.7, roughness=0.3)
        ball = sphere([0.2, 0.1, 0.4], 0.4, row, 8)
        parts = [textured_floor(material(**columns)), ball, SKY_LAMP]
        return textured(parts, (texture,), index, scale=2.0)

    return made


def _bumpy_caustics() -> Scene:
    """A bumpy, smooth mirror that throws the light of a small lamp on a floor: light paths land."""
    panel = [[-0.9, 0.5, 0.02], [0.9, 0.5, 0.02], [0.9, 0.7, 1.2], [-0.9, 0.7, 1.2]]
    mirror = quad(panel, material(specular=0.9, roughness=0.25))
    lamp = light([[-0.2, -0.9, 0.8], [0.2, -0.9, 0.8], [0, -0.9, 1.1]], 40.0)
    return mapped([mirror, textured_floor(material(diffuse=0.8)), lamp], bumps(2, 0.8))


TURN = uniform_rotation(np.random.default_rng(3)).astype(np.float32)
QUICK: dict[str, Callable[[], Scene]] = {
    "lamps": lambda: _room(5),
    "sun": lambda: open_scene(one_sun(1e5)),
    "bumps": bumpy_room,  # many normals turn away from the viewer or the lamp
    "bumpy caustics": _bumpy_caustics,
}
SLOW: dict[str, Callable[[], Scene]] = {
    "smooth": lambda: open_scene(smooth(rotation=TURN), 0),
    "night": lambda: open_scene(night()),
    "diffuse": _textured_room(noise_map(3, 3, 0, 0.95), [0, -1, -1], specular=0.05, roughness=0.5),
    "roughness": _textured_room(noise_map(4, 1, 0.2, 1), [-1, -1, 0], diffuse=0.1, specular=0.8),
    "specular": _textured_room(noise_map(5, 3, 0, 0.9), [-1, 0, -1], diffuse=0.1, roughness=0.4),
}


@pytest.mark.parametrize(
    "made",
    [
        *QUICK.values(),
        *(pytest.param(each, marks=pytest.mark.slow("statistics")) for each in SLOW.values()),
    ],
    ids=[*QUICK, *SLOW],
)
def test_both_integrators_agree_within_their_noise(
    made: Callable[[], Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Around one and the same BRDF, at every roughness, with white emitters and normal maps."""
    scene = made()
    ours = render_blocks(scene)
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=5)
    theirs = render_blocks(scene, first_seed=500, tracer=twin)
    # The twins of an emitter stand 1e-4 off, which moves direct light by about as much.
    assert_agree(ours, theirs, slack=1e-3)
    # Wider than without a sky for the mean: channels and blocks share their luck with a few
    # small lamps, and 115 scores of the night are worth 45 independent ones. In ten repeats of 16
    # passes their mean had a standard deviation of 0.15 with lamps and 0.21 without, and no bias:
    # over 160 passes it was 0.07 and 0.05, and all light together differed by 0.08 and 0.09 %.
    wider = {"most": 1.35, "bias": 0.5} if scene.environment else {}
    assert_honest(ours, theirs, **wider)
    if scene.textures:
        plain = render_blocks(dataclasses.replace(scene, **NO_TEXTURES), passes=4)
        assert np.abs(scores(ours, plain)).max() > 20  # the test sees textures


_IN_SCALAR = """
import json
import pipeline.renders  # which loads what the system may lack
import mitsuba
mitsuba.set_variant("scalar_rgb")
import drjit
drjit.set_thread_count(1)  # reflections call Python, where threads queue for its lock
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.test_twin_tracers import _room
scene = _room(5)
tracer = PluginTracer(scene, max_depth=10, rr_depth=5)
camera = camera_of(scene, 16)
means = [tracer.radiance(camera, seed=k, spp=16).mean(axis=(0, 1)).tolist() for k in range(8)]
print(json.dumps([means, int(tracer.hits(camera).sum())]))
"""


def test_the_oracle_agrees_where_nothing_is_compiled() -> None:
    """In `scalar_rgb` it shares neither LLVM nor a kernel with ours."""
    means, num_hits = json.loads(printed_by(_IN_SCALAR))
    scene = _room(5)
    ours = render_blocks(scene, resolution=16, block=16)
    error = np.hypot(np.std(means, axis=0, ddof=1) / np.sqrt(len(means)), ours.error[0, 0])
    # Five standard errors, of which one comes from eight values only.
    assert (np.abs(np.mean(means, axis=0) - ours.mean[0, 0]) < 5 * error).all()
    tracer = load_tracer(scene, max_depth=10, rr_depth=5)
    assert abs(int(tracer.hits(camera_of(scene, 16)).sum()) - num_hits) <= 1


DIM = 0.125
PANEL = np.array([[-0.5, 1.0, 0.5], [0.5, 1.0, 0.5], [0.0, 1.0, 1.5]])
BRIGHT = np.array([[-0.5, 0.0, 2.5], [0.5, 0.0, 2.5], [0.0, 0.4, 2.5]])
RADIANCE = 20.0


def _panel_in_a_mirror(panel: Part) -> Scene:
    """Emitters are hidden from the camera, so that their surface shows in a mirror only."""
    floor = [[-12, -12, 0], [12, -12, 0], [12, 12, 0], [-12, 12, 0]]
    mirror = quad(floor, material(specular=1.0, roughness=0.01))
    bright = light(BRIGHT, RADIANCE)
    return join([mirror, panel, bright], eye=(0, -2, 1), target=(0, 1, -0.9), fov_deg=4)


def _reflected(scene: Scene, albedo: float) -> Any:
    """Return what the panel shows of the bright light by Lambert's formula, [8, 8, 3]."""
    origin, directions = camera_rays(scene.c2w[0], float(scene.fov_deg[0]), 64)
    origin, directions = origin * [1, 1, -1], directions * [1, 1, -1]
    points = origin + directions * ((1 - origin[1]) / directions[..., 1:2])
    normal = np.array([0.0, -1.0, 0.0])
    irradiance = lambert_irradiance(points.reshape(-1, 3), normal, BRIGHT, RADIANCE)
    blocks = (irradiance * albedo / np.pi).reshape(8, 8, 8, 8).mean(axis=(1, 3))
    return np.repeat(blocks[..., None], 3, axis=-1)


@pytest.mark.parametrize("diffuse", [0.0, 1.0])
def test_a_panel_shows_its_emission_and_what_it_reflects(diffuse: float) -> None:
    scene = _panel_in_a_mirror(light(PANEL, DIM, diffuse))
    estimate = render_blocks(scene, max_depth=3, rr_depth=9)
    # The mirror blurs by 1e-4 and returns all light.
    assert_agree(estimate, exact(DIM + _reflected(scene, diffuse)), slack=2e-3)


def test_a_faint_emitter_is_a_surface() -> None:
    """At all depths a panel that hardly emits looks, in the mirror, as one that does not emit."""
    row = material(diffuse=[0.2, 0.5, 0.3], specular=0.4, roughness=0.5)
    faint = row + material(roughness=0, emission=1e-6)
    scenes = [_panel_in_a_mirror(flat(PANEL, *kind)) for kind in ((row,), (faint, "emitter"))]
    surface, emitter = (
        render_blocks(each, passes=8, first_seed=k) for k, each in enumerate(scenes)
    )
    assert surface.mean.max() > 0.01
    assert_agree(emitter, surface, slack=2e-3)  # as above


SETTINGS = view_settings(32, noise_floor_db=60.0, aux_spp=16)

APART = dataclasses.replace(SETTINGS, split=True, split_lobes=True)
"""By bounces and by lobes."""
KINDS = [{"split": True}, {"split_lobes": True}, {"split": True, "split_lobes": True}]
FLOOR = quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=0.5))
LAMP = np.array([[-0.5, -1.5, 2], [0.5, -1.5, 2], [0, -1, 2.4]])


@pytest.mark.parametrize(("kind", "max_spp"), [*zip(KINDS, (32, 32, 1024), strict=True)])
def test_the_stored_picture_is_the_sum_of_its_parts(kind: dict[str, Any], max_spp: int) -> None:
    """To the last bit, with pictures that the denoiser made and some whose glints are kept."""
    settings = dataclasses.replace(SETTINGS, max_spp=max_spp, noise_floor_db=90.0, **kind)
    view = render_view(mirrors(), settings)
    assert view.parts_rgb is not None and view.part_floors is not None
    assert tuple(view.parts_rgb) == tuple(view.part_floors) == settings.part_names
    for part in view.parts_rgb.values():
        assert part.shape == (32, 32, 3) and part.min() >= 0 and part.mean() > 1e-3
        np.testing.assert_array_equal(part, rounded_to_half(part))
    np.testing.assert_array_equal(sum_of_parts(view.parts_rgb), view.radiance_rgb)
    np.testing.assert_array_equal(decode_exr(encode_exr(view.radiance_rgb)), view.radiance_rgb)


def test_lights_apart_are_split_alike() -> None:
    view = render_view(lit_scene(), dataclasses.replace(APART, per_light=True))
    assert view.parts_rgb is not None and view.lights_rgb is not None
    assert {part.shape for part in view.parts_rgb.values()} == {(3, 32, 32, 3)}
    np.testing.assert_array_equal(sum_of_parts(view.parts_rgb), view.lights_rgb)
    np.testing.assert_array_equal(sum_of_lights(view.lights_rgb), view.radiance_rgb)
    together = render_view(lit_scene(), APART)
    assert together.parts_rgb is not None
    for name, part in view.parts_rgb.items():
        agreement = psnr_log_db(sum_of_lights(part), together.parts_rgb[name])
        assert agreement > together.noise_floor_db


def test_light_that_is_not_there_is_exactly_nothing() -> None:
    """Only direct light on a lone floor; behind a screen, lit by a ceiling, none."""
    alone = render_view(join([FLOOR, light(LAMP, 20.0)], eye=(0, -3, 2)), APART)
    assert alone.parts_rgb is not None and alone.part_floors is not None
    np.testing.assert_array_equal(alone.parts_rgb["diffuse_direct"], alone.radiance_rgb)
    for name in ("diffuse_indirect", "specular_direct", "specular_indirect"):
        np.testing.assert_array_equal(alone.parts_rgb[name], 0)
        assert alone.part_floors[name].noise_floor_db == MAX_DB
    assert alone.part_floors["diffuse_direct"].noise_floor_db == alone.noise_floor_db < MAX_DB
    screen = np.array([[-3, 0, 0], [3, 0, 0], [3, 0, 9], [-3, 0, 9]])
    ceiling = np.array([[-3, -3, 9.5], [3, -3, 9.5], [3, 3, 9.5], [-3, 3, 9.5]])
    walls = [quad(corners, material(diffuse=0.8)) for corners in (screen, ceiling)]
    lamp = light([[-0.5, 1, 8], [0.5, 1, 8], [0, 1.5, 8.4]], 4000.0)
    room = [FLOOR, *walls, lamp]
    hidden = render_view(join(room, eye=(0, -3, 3), target=(0, -1.5, 0), fov_deg=25), APART)
    assert hidden.parts_rgb is not None
    np.testing.assert_array_equal(hidden.parts_rgb["diffuse_direct"], 0)
    np.testing.assert_array_equal(hidden.parts_rgb["diffuse_indirect"], hidden.radiance_rgb)
    assert hidden.radiance_rgb.mean() > 0.01


def test_what_has_no_lobe_shows_none_of_its_light_once_denoised() -> None:
    """A metal ball on a matt floor: only pixels at its rim show both."""
    ball = sphere([0, 0, 0.5], 0.5, material(specular=0.9, roughness=0.3), rings=8)
    scene = join([FLOOR, ball, light(LAMP, 20.0)], eye=(0, -3, 2), target=(0, 0, 0.4))
    found = render_view(scene, APART).parts_rgb
    assert found is not None
    diffuse, specular = (
        (found[f"{lobe}_direct"] + found[f"{lobe}_indirect"]).max(axis=-1) > 0
        for lobe in ("diffuse", "specular")
    )
    rim = diffuse & specular
    # the ball is some 14 pixels wide, so that its rim is some 44 pixels long and 1 to 2 wide
    assert rim.sum() < 90 and (diffuse & ~rim).sum() > 300 and (specular & ~rim).sum() > 90


@pytest.mark.slow("statistics")
def test_floors_of_parts_are_honest() -> None:
    """On average over samples; of one set of samples a floor is itself an estimate.

    Measured: the mean of six is 1.4 to 2.9 dB below the truth, part by part, and one of the 24 is
    2.7 dB above. The truths of 16,384 samples agree to 58 dB and more, 11 dB above every picture.
    """
    few = dataclasses.replace(APART, min_spp=128, max_spp=256)
    whole = dataclasses.replace(few, max_spp=16_384, min_spp=16_384, denoiser="off")
    truth = render_view(mirrors(), whole, seed=99).parts_rgb
    assert truth is not None
    views = [render_view(mirrors(), few, seed) for seed in range(6)]
    for name, right in truth.items():
        too_good_db = []
        for view in views:
            assert view.parts_rgb is not None and view.part_floors is not None
            true_db = psnr_log_db(view.parts_rgb[name], right)
            too_good_db.append(view.part_floors[name].noise_floor_db - true_db)
        assert np.mean(too_good_db) < 0, name
        assert max(too_good_db) < 4, name


def test_too_many_pictures_are_rejected() -> None:
    count = MAX_LIGHTS // 2 + 1
    lamps = [light(np.add(LAMP, [0.01 * i, 0, 0]), 1.0) for i in range(count)]
    scene = join([FLOOR, *lamps])
    SceneRenderer(scene, dataclasses.replace(SETTINGS, per_light=True))
    with pytest.raises(Rejected, match=f"too_many_lights.*{count} lights apart; at most 32"):
        SceneRenderer(scene, dataclasses.replace(SETTINGS, per_light=True, split=True))


def _build(scene: Scene, **renders: Any) -> tuple[Sample, DatasetSettings]:
    """Return a sample of two views, as a build with these settings of renders makes it."""
    asked = {"min_spp": 8, "max_spp": 8, **renders}
    changes = {f"renders.{name}": value for name, value in asked.items()} | {"scenes.num_views": 2}
    settings = preset_settings("smoke", resolution=16, changes=changes)
    scene_input = RenderInput(scene=scene.with_provenance({"camera_attempts": [0, 0]}))
    return render_sample("000000007", scene_input, settings, [], ViewProgress(None, 7)), settings


def test_all_views_and_lights_share_one_load(monkeypatch: pytest.MonkeyPatch) -> None:
    load = Mock(wraps=kernel_scene.build_mitsuba_scene)
    monkeypatch.setattr(kernel_scene, "build_mitsuba_scene", load)
    scene = sampled_like_scene(np.random.default_rng(3), num_views=2)
    assert len(_build(scene, per_light=True)[0].views) == 2
    assert load.call_count == 2  # what camera rays meet, and what all other rays meet


def test_a_build_with_the_setting_stores_what_verify_accepts() -> None:
    """`--set renders.per_light=true` or split, from the settings to the members of a sample."""
    for kind, per_light in (({}, True), (KINDS[0], False), (KINDS[2], True)):
        sample, settings = _build(tiny_scene(), per_light=per_light, **kind)
        manifest = Manifest(
            build="smoke",
            settings=settings_record(settings),
            environment={},
            num_scenes=1,
            num_views=2,
            objects_lock_sha256="",
            shards=(),
        )
        back = decode_sample(sample.key, encode_sample(sample))
        back.check()
        assert list(check_sample(back, "train", manifest, {})) == []
        assert back.views == sample.views
        shape = (2, 1, 16, 16, 3) if per_light else (2, 16, 16, 3)
        pictures = [*(back.parts_rgb or {}).values(), *([back.lights_rgb] if per_light else [])]
        assert {picture.shape for picture in pictures if picture is not None} == {shape}
        assert (back.parts_rgb is not None) == bool(kind)
        np.testing.assert_array_equal(back.radiance_rgb, sample.radiance_rgb)


def _tracer(scene: Scene, *, bounces: bool, lobes: bool, max_depth: int = 10) -> VectorTracer:
    tracer = load_tracer(scene, max_depth=max_depth, rr_depth=2)
    return tracer.split_lights(bounces=bounces, lobes=lobes)


def _passes(
    scene: Scene, *, bounces: bool, lobes: bool, max_depth: int = 10, seeds: int = 1, px: int = 32
) -> dict[str, NDArray[np.float64]]:
    """Return independent passes of 64 samples by part, [seeds, px, px, 3]."""
    tracer = _tracer(scene, bounces=bounces, lobes=lobes, max_depth=max_depth)
    found = []
    for seed in range(seeds):
        total = tracer.pass_sum(camera_of(scene, px))
        total.add(seed=seed, spp=64)
        found.append(np.stack(total.read()[:-3]) / 64)
    return dict(zip(part_names(bounces=bounces, lobes=lobes), np.stack(found, axis=1), strict=True))


@pytest.mark.parametrize(
    ("bounces", "lobes", "guided"),
    [(True, False, False), (False, True, False), (True, True, True)],
)
def test_the_parts_add_up_to_the_picture_of_the_same_samples(
    bounces: bool, lobes: bool, guided: bool
) -> None:
    """But for roundings: a light path counts in whole units, everything else is float32."""
    chosen = np.random.default_rng(0).random((32, 32)) < 0.7
    for scene in (mirrors(), open_scene(smooth(is_seen=True))):
        sums = []
        for kind in ({"bounces": bounces, "lobes": lobes}, {"bounces": False, "lobes": False}):
            total = _tracer(scene, **kind).pass_sum(camera_of(scene, 32))
            if guided:
                total.guide()
            total.add(seed=3, spp=64, chosen=chosen)
            *pictures, squares, _, _ = total.read()
            sums.append((np.stack(pictures), squares))
        (parts, squares), (whole, squares_of_whole) = sums
        assert len(parts) == (4 if bounces and lobes else 2) and len(whole) == 1
        assert parts.min() >= 0 and parts.mean(axis=(1, 2, 3)).min() > 0
        np.testing.assert_allclose(parts.sum(axis=0), whole[0], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(squares, squares_of_whole, rtol=1e-4, atol=1e-4)


def test_direct_light_is_what_paths_of_two_edges_find() -> None:
    """The first bounce has the same random numbers, whatever comes after it."""
    for scene in (mirrors(), open_scene(smooth(is_seen=True))):
        parts = _passes(scene, bounces=True, lobes=False)
        short = load_tracer(scene, max_depth=2, rr_depth=2)
        whole = short.radiance(camera_of(scene, 32), seed=0, spp=64)
        # a mean of 64 samples in float32
        np.testing.assert_allclose(parts["direct"][0], whole, rtol=1e-5, atol=1e-6)
        none = _passes(scene, bounces=True, lobes=False, max_depth=2)
        np.testing.assert_array_equal(none["indirect"], 0)
        assert parts["indirect"].mean() > 0.02 * parts["direct"].mean()


def test_in_a_furnace_each_lobe_shows_its_albedo_by_direct_light_alone() -> None:
    """A convex body in an even glow: no light reaches it by way of another surface."""
    diffuse, specular = [0.5, 0.3, 0.1], [0.2, 0.4, 0.6]
    body = box([0, 0, 0], 0.8, material(diffuse=diffuse, specular=specular, roughness=0.1), 0.5)
    scene = join([body, furnace()], eye=(0, -1.5, 0.8), fov_deg=15)
    kind = {"bounces": True, "lobes": True}
    found = _passes(scene, **kind, seeds=16, px=8)
    for name in ("diffuse_indirect", "specular_indirect"):
        np.testing.assert_array_equal(found[name], 0)
    for name, albedo in (("diffuse_direct", diffuse), ("specular_direct", specular)):
        # so smooth a lobe loses 0.2 % to its own shadows, of which colour keeps a part
        albedos = exact(np.broadcast_to(albedo, (2, 2, 3)))
        assert_agree(blocks_of(found[name], 4), albedos, slack=0.005)


def test_kernels_of_other_parts_are_apart() -> None:
    """One process may trace all kinds of one scene, in any order."""
    scene, kinds = mirrors(), list(itertools.product((False, True), repeat=2))
    first: dict[tuple[bool, bool], NDArray[np.float32]] = {}
    for bounces, lobes in itertools.chain(kinds, reversed(kinds)):
        tracer = _tracer(scene, bounces=bounces, lobes=lobes)
        picture = tracer.radiance(camera_of(scene, 16), seed=1, spp=16)
        np.testing.assert_array_equal(picture, first.setdefault((bounces, lobes), picture))
