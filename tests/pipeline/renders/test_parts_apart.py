"""Direct and indirect light, diffuse and specular: stored pictures whose sum is the picture."""

import dataclasses

import numpy as np
import pytest

from pipeline.builds.named import named_build
from pipeline.making.render_sample import BegunScene, render_sample
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from storage.dataset.manifest import Manifest
from storage.dataset.verify import check_sample
from storage.errors import Rejected
from storage.metrics import MAX_DB, psnr_log_db
from storage.records.exr import decode_exr, encode_exr
from storage.records.lights import MAX_LIGHTS, rounded_to_half, sum_of_lights
from storage.records.parts import sum_of_parts
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import Scene
from storage.settings.described import settings_record
from tests.pipeline.renders.guided_scenes import mirrors
from tests.pipeline.renders.scene_kit import join, light, material, quad, sphere
from tests.pipeline.renders.test_lights_apart import lit_scene
from tests.scenes_by_hand import tiny_scene

SETTINGS = RenderSettings(
    resolution=32, noise_floor_db=60.0, min_spp=32, max_spp=32, aux_spp=16, split=True
)
KINDS = [{"split": True}, {"split_lobes": True}, {"split": True, "split_lobes": True}]
FLOOR = quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=0.5))
LAMP = np.array([[-0.5, -1.5, 2], [0.5, -1.5, 2], [0, -1, 2.4]])


def _render(scene: Scene, settings: RenderSettings, seed: int = 0) -> RenderedView:
    renderer = SceneRenderer(scene, settings)
    return renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)


def _with(settings: RenderSettings, **changes: object) -> RenderSettings:
    plain = dataclasses.replace(settings, split=False)
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(("kind", "max_spp"), [*zip(KINDS, (32, 32, 1024), strict=True)])
def test_the_stored_picture_is_the_sum_of_its_parts(
    llvm: None, kind: dict[str, bool], max_spp: int
) -> None:
    """To the last bit, with pictures that the denoiser made and some whose glints are kept."""
    settings = _with(SETTINGS, max_spp=max_spp, noise_floor_db=90.0, **kind)
    view = _render(mirrors(), settings)
    assert view.parts_rgb is not None and view.part_floors is not None
    assert tuple(view.parts_rgb) == tuple(view.part_floors) == settings.part_names
    for part in view.parts_rgb.values():
        assert part.shape == (32, 32, 3) and part.min() >= 0 and part.mean() > 1e-3
        np.testing.assert_array_equal(part, rounded_to_half(part))
    np.testing.assert_array_equal(sum_of_parts(view.parts_rgb), view.radiance_rgb)
    np.testing.assert_array_equal(decode_exr(encode_exr(view.radiance_rgb)), view.radiance_rgb)


@pytest.mark.parametrize("per_light", [False, True])
def test_raw_parts_are_the_picture_that_is_rendered_without(llvm: None, per_light: bool) -> None:
    """The same samples: up to 12 roundings to half floats and one of the sum, 2^-11 each."""
    raw = _with(SETTINGS, denoiser="off", per_light=per_light)
    whole = _render(lit_scene(), raw)
    assert whole.parts_rgb is None and whole.part_floors is None
    for kind in KINDS:
        split = _render(lit_scene(), _with(raw, **kind))
        np.testing.assert_allclose(
            split.radiance_rgb, whole.radiance_rgb, rtol=3 * 2**-11, atol=1e-6, err_msg=str(kind)
        )
        assert split.noise_floor_db == pytest.approx(whole.noise_floor_db, abs=0.01), kind
        assert split.spp == whole.spp


def test_lights_apart_are_split_alike(llvm: None) -> None:
    both = _with(SETTINGS, per_light=True, split=True, split_lobes=True)
    view = _render(lit_scene(), both)
    assert view.parts_rgb is not None and view.lights_rgb is not None
    assert {part.shape for part in view.parts_rgb.values()} == {(3, 32, 32, 3)}
    np.testing.assert_array_equal(sum_of_parts(view.parts_rgb), view.lights_rgb)
    np.testing.assert_array_equal(sum_of_lights(view.lights_rgb), view.radiance_rgb)
    together = _render(lit_scene(), dataclasses.replace(both, per_light=False))
    assert together.parts_rgb is not None
    for name, part in view.parts_rgb.items():
        agreement = psnr_log_db(sum_of_lights(part), together.parts_rgb[name])
        assert agreement > together.noise_floor_db


def test_light_that_is_not_there_is_exactly_nothing(llvm: None) -> None:
    """Only direct light on a lone floor; behind a screen, lit by a ceiling, none."""
    settings = _with(SETTINGS, split=True, split_lobes=True)
    alone = _render(join([FLOOR, light(LAMP, 20.0)], eye=(0, -3, 2)), settings)
    assert alone.parts_rgb is not None and alone.part_floors is not None
    np.testing.assert_array_equal(alone.parts_rgb["diffuse_direct"], alone.radiance_rgb)
    for name in ("diffuse_indirect", "specular_direct", "specular_indirect"):
        np.testing.assert_array_equal(alone.parts_rgb[name], 0)
        assert alone.part_floors[name].log_db == MAX_DB
    assert alone.part_floors["diffuse_direct"].log_db == alone.noise_floor_db < MAX_DB
    screen = np.array([[-3, 0, 0], [3, 0, 0], [3, 0, 9], [-3, 0, 9]])
    ceiling = np.array([[-3, -3, 9.5], [3, -3, 9.5], [3, 3, 9.5], [-3, 3, 9.5]])
    walls = [quad(corners, material(diffuse=0.8)) for corners in (screen, ceiling)]
    lamp = light([[-0.5, 1, 8], [0.5, 1, 8], [0, 1.5, 8.4]], 4000.0)
    room = [FLOOR, *walls, lamp]
    hidden = _render(join(room, eye=(0, -3, 3), target=(0, -1.5, 0), fov_deg=25), settings)
    assert hidden.parts_rgb is not None
    np.testing.assert_array_equal(hidden.parts_rgb["diffuse_direct"], 0)
    np.testing.assert_array_equal(hidden.parts_rgb["diffuse_indirect"], hidden.radiance_rgb)
    assert hidden.radiance_rgb.mean() > 0.01


def test_what_has_no_lobe_shows_none_of_its_light_once_denoised(llvm: None) -> None:
    """A metal ball on a matt floor: only pixels at its rim show both."""
    ball = sphere([0, 0, 0.5], 0.5, material(specular=0.9, roughness=0.3), rings=8)
    scene = join([FLOOR, ball, light(LAMP, 20.0)], eye=(0, -3, 2), target=(0, 0, 0.4))
    found = _render(scene, _with(SETTINGS, split=True, split_lobes=True)).parts_rgb
    assert found is not None
    diffuse, specular = (
        (found[f"{lobe}_direct"] + found[f"{lobe}_indirect"]).max(axis=-1) > 0
        for lobe in ("diffuse", "specular")
    )
    rim = diffuse & specular
    # the ball is some 14 pixels wide, so that its rim is some 44 pixels long and 1 to 2 wide
    assert rim.sum() < 90 and (diffuse & ~rim).sum() > 300 and (specular & ~rim).sum() > 90


@pytest.mark.slow("statistics")
def test_floors_of_parts_are_honest(llvm: None) -> None:
    """On average over samples; of one set of samples a floor is itself an estimate.

    Measured: the mean of six is 1.4 to 2.9 dB below the truth, part by part, and one of the 24 is
    2.7 dB above. The truths of 16,384 samples agree to 58 dB and more, 11 dB above every picture.
    """
    few = _with(SETTINGS, min_spp=128, max_spp=256, split=True, split_lobes=True)
    whole = dataclasses.replace(few, max_spp=16_384, min_spp=16_384, denoiser="off")
    truth = _render(mirrors(), whole, seed=99).parts_rgb
    assert truth is not None
    views = [_render(mirrors(), few, seed) for seed in range(6)]
    for name, right in truth.items():
        too_good_db = []
        for view in views:
            assert view.parts_rgb is not None and view.part_floors is not None
            true_db = psnr_log_db(view.parts_rgb[name], right)
            too_good_db.append(view.part_floors[name].log_db - true_db)
        assert np.mean(too_good_db) < 0, name
        assert max(too_good_db) < 4, name


def test_too_many_pictures_are_rejected(llvm: None) -> None:
    count = MAX_LIGHTS // 2 + 1
    lamps = [light(np.add(LAMP, [0.01 * i, 0, 0]), 1.0) for i in range(count)]
    scene = join([FLOOR, *lamps])
    SceneRenderer(scene, _with(SETTINGS, per_light=True))
    with pytest.raises(Rejected, match=f"too_many_lights.*{count} emitters apart; at most 32"):
        SceneRenderer(scene, _with(SETTINGS, per_light=True, split=True))


def test_settings_that_ask_for_nothing_are_those_of_before() -> None:
    """Their record is part of digests, which must stay."""
    assert not {"split", "split_lobes"} & set(settings_record(_with(SETTINGS)))
    assert settings_record(SETTINGS)["split"] is True


@pytest.mark.parametrize(("kind", "per_light"), [(KINDS[0], False), (KINDS[2], True)])
def test_a_build_with_the_setting_stores_what_verify_accepts(
    llvm: None, kind: dict[str, bool], per_light: bool
) -> None:
    """`--set renders.split=true`, from the settings to the members of a sample."""
    asked = {**kind, "per_light": per_light, "min_spp": 8, "max_spp": 8}
    changes = {f"renders.{name}": value for name, value in asked.items()}
    settings = named_build("smoke", resolution=16, changes={**changes, "scenes.num_views": 2})
    scene = tiny_scene(provenance={"camera_attempts": [0, 0]})
    sample = render_sample(
        "000000007", BegunScene(scene=scene), settings, [], ViewProgress(None, 7)
    )
    manifest = Manifest(
        build="smoke",
        settings=settings.as_json(),
        environment={},
        num_scenes=1,
        num_views=2,
        objects_lock_sha256="",
        shards=(),
    )
    back = decode_sample(sample.key, encode_sample(sample))
    back.check()
    assert list(check_sample(back, "train", manifest, {})) == []
    assert back.parts_rgb is not None and back.views == sample.views
    shape = (2, 1, 16, 16, 3) if per_light else (2, 16, 16, 3)
    assert {part.shape for part in back.parts_rgb.values()} == {shape}
    np.testing.assert_array_equal(back.radiance_rgb, sample.radiance_rgb)
