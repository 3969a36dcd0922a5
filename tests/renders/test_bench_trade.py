"""Knobs of pictures on a scene by hand: what must get better or worse does, and all is priced."""

import dataclasses
import functools

import pytest

from infra.bench.harness import Options
from infra.bench.renders.fixed_samples import fixed_samples
from infra.bench.trade import path_knobs, picture_knobs, render_knobs, stored_knobs
from infra.bench.trade.bare_pictures import bare_pictures
from infra.bench.trade.curves import Curve, Knob, Point, judged
from infra.bench.trade.knobs import knob_named
from infra.bench.trade.rendered import shots
from infra.bench.trade.workshop import Subject, Workshop
from pipeline.renders.renderer import SceneRenderer
from storage.metrics import psnr_log_db
from storage.seeds import rng_for
from tests.infra.trade_kit import TINY
from tests.renders.scene_kit import sampled_like_scene

EFFORT = dataclasses.replace(TINY, scenes=1, fixed_spp=128)
OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=())


@functools.cache
def _subject() -> Subject:
    scene = sampled_like_scene(rng_for(0, "trade"), num_views=1)
    reference = SceneRenderer(scene, fixed_samples(32, 2048)).render_view(
        scene.c2w[0], float(scene.fov_deg[0]), 1_000_003
    )
    return Subject(scene=scene, reference_rgb=reference.radiance_rgb)


class _Here(Workshop):
    """A workshop whose child is this process, with one small scene."""

    def call(self, function, *arguments):  # type: ignore[no-untyped-def]
        return function(*arguments)

    @property
    def subjects(self) -> tuple[Subject, ...]:
        return (_subject(),)


def _measured(name: str) -> dict[str, Point]:
    knob, shop = knob_named(name), _Here(EFFORT, OPTIONS)
    curve = knob.measure(shop)
    shop.close()
    _is_whole(knob, curve)
    return {point.setting: point for point in curve.points}


def _is_whole(knob: Knob, curve: Curve) -> None:
    assert sum(one.point.default for one in judged(knob, curve)) == 1
    assert all(point.cost > 0 for point in curve.points)
    assert len({point.setting for point in curve.points}) == len(curve.points) > 1
    assert any(one.on_front for one in judged(knob, curve))
    assert curve.measured_on


def _error(point: Point) -> float:
    assert point.error is not None
    return point.error


def test_every_knob_of_pictures_is_tested_here() -> None:
    modules = (render_knobs, path_knobs, picture_knobs, stored_knobs)
    names = {knob.name for module in modules for knob in module.KNOBS}
    elsewhere = {"codec", "views"}  # tests/infra/test_bench_trade*.py
    assert names - elsewhere == {
        "samples", "noise-floor", "first-samples", "guides", "depth", "roulette", "resolution",
        "lights", "arrays",
    }  # fmt: skip


def test_samples_and_the_denoiser_bring_a_picture_nearer() -> None:
    found = _measured("samples")
    raw, high = (found[f"128, {name}"] for name in ("off", "high"))
    # quarter as many samples: twice the error of a raw picture, 6 dB; half of that is left for luck
    assert _error(raw) > _error(found["32, off"]) + 3
    assert _error(high) > _error(raw)
    assert [point.default for point in found.values()].index(True) == len(found) - 1


@pytest.mark.parametrize("name", ["noise-floor", "first-samples", "guides", "roulette"])
def test_settings_of_one_estimator_come_near_the_reference(name: str) -> None:
    for point in _measured(name).values():
        assert _error(point) > 35  # a bright easy scene; a picture of something else has below 20


def test_short_paths_lose_light() -> None:
    found = _measured("depth")
    assert found["2"].further["light lost %"] > found["4"].further["light lost %"] > 0
    assert _error(found["2"]) < _error(found["4"]) < _error(found["16"])


def test_a_smaller_picture_keeps_less() -> None:
    found = list(_measured("resolution").values())
    errors = [_error(point) for point in found]
    assert errors == sorted(errors) and errors[-1] == 100
    assert [point.setting for point in found if point.default] == ["32 x 32"]


def test_lights_apart_cost_more_bytes() -> None:
    together, apart = _measured("lights").values()
    assert apart.further["kB"] > together.further["kB"]


def test_rounded_arrays_are_smaller_and_less_exact() -> None:
    exact, half, positions = _measured("arrays").values()
    assert exact.cost > half.cost > positions.cost
    assert _error(exact) == 100 > _error(half)


def test_shared_passes_are_the_pictures_that_each_setting_gives_alone() -> None:
    scene = _subject().scene
    variants = {str(spp): fixed_samples(32, spp) for spp in (32, 128)}
    together = shots(scene, variants)
    for name, settings in variants.items():
        alone = shots(scene, {name: settings})[name]
        assert (together[name].view.radiance_rgb == alone.view.radiance_rgb).all()
        assert together[name].core_s > 0 and alone.view.spp == int(name)


def test_bare_pictures_come_nearer_with_samples() -> None:
    subject = _subject()
    sampled, denoised = (one.levels for one in bare_pictures(subject.scene, 32, (1, 8, 128)))
    assert [one.spp for one in sampled] == [one.spp for one in denoised] == [1, 8, 128]
    raw = [psnr_log_db(one.radiance_rgb, subject.reference_rgb) for one in sampled]
    clean = [psnr_log_db(one.radiance_rgb, subject.reference_rgb) for one in denoised]
    # 128 times the samples are 21 dB of a raw picture; half of that is left for luck
    assert raw[2] > raw[0] + 10 and clean[2] > clean[0]
    assert clean[0] > raw[0]
    assert denoised[0].core_s > sampled[0].core_s > 0
    # the mean of all samples is the scene's light, up to the noise of 128 of them
    mean = subject.reference_rgb.mean()
    assert abs(sampled[2].radiance_rgb.mean() / mean - 1) < 0.02
